"""The fields that represent Gymnasium environments in godot-gym."""

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
    """Return the names of the fields for the leaves of an observation.

    A space without parts has the single field ``observation``. Parts are named by their keys,
    joined by ``__``, if all of these names are valid and distinct; otherwise by their numbers.
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
