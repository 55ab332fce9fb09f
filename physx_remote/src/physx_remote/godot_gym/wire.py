"""The fields in which Gymnasium environments travel over godot-gym."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_remote.godot_gym.messages import Messages
from physx_remote.serving.spaces import SpaceTree

OBSERVATION = "observation"
OUTCOME = {"reward": float, "terminated": bool, "truncated": bool, "info": str}
"""Fields of the world's data of every Gymnasium environment; `info` is JSON text."""

_RESERVED = {"env_id", "episode", "step"}


def observation_fields(tree: SpaceTree) -> list[str]:
    """Return the names of the fields that carry the leaves of an observation.

    The field of a space without parts is ``observation``. A part is named by its keys, joined by
    ``__``, if that gives every part a valid and distinct name, and by its number otherwise.
    """
    if tree.is_leaf:
        return [OBSERVATION]
    names = ["__".join(str(key) for key in path) for path in tree.paths]
    is_valid = all(n.isascii() and n.isidentifier() and n[0] != "_" for n in names)
    is_distinct = len({name.lower() for name in names}) == len(names)
    if is_valid and is_distinct and _RESERVED.isdisjoint(names):
        return names
    return [f"{OBSERVATION}_{number}" for number in range(len(names))]


def gymnasium_messages(tree: SpaceTree) -> Messages:
    """Return the messages of a Gymnasium environment with the observation space of `tree`."""
    fields = [
        Field(name, () if isinstance(leaf, spaces.Discrete) else leaf.shape, np.dtype(leaf.dtype))
        for name, leaf in zip(observation_fields(tree), tree.leaves, strict=True)
    ]
    return Messages.of_fields(agent=fields, world=list(OUTCOME.items()))
