"""`gymnasium.make_vec` with physx's vector environments, for any registered id.

An id is registered with ``vector_entry_point="physx_gym.vectors:<id>"``: text, as specifications
are stored and sent as JSON.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium

from physx_core.plugins import reference_of

_OPTIONS = (
    *("num_processes", "batch_size", "autoreset_mode", "copy", "timeout"),
    *("launcher", "launcher_kwargs", "ip_address", "retries"),
)
_KNOWN_EVERYWHERE = ("gymnasium", "physx_gym")


def make_vector(id: str, num_envs: int, **options: Any) -> Any:
    """Return a vector environment whose environments run in separate processes.

    Args:
        id: Id of the environment.
        num_envs: Number of environments.
        options: ``num_processes``, ``batch_size``, ``autoreset_mode``, ``copy``, ``timeout``,
            ``launcher``, ``launcher_kwargs``, ``ip_address`` and ``retries`` of
            `ParallelVectorEnv`; all others go to each environment.
    """
    from physx_gym.vector.vector_env import ParallelVectorEnv

    own = {name: options.pop(name) for name in _OPTIONS if name in options}
    return ParallelVectorEnv(_with_module(id), num_envs, env_kwargs=options, **own)


def __getattr__(id: str) -> Any:
    """Return the vector entry point of an id, as Gymnasium looks it up."""
    if id not in gymnasium.registry:
        raise AttributeError(f"{__name__} has no attribute {id!r}, and there is no such id.")
    return partial(make_vector, id)


def _with_module(id: str) -> str:
    """Return an id with the module of its entry point, which other processes import first."""
    entry: Any = gymnasium.registry[id].entry_point
    place = reference_of(entry).rpartition(":")[0]
    return id if place.partition(".")[0] in _KNOWN_EVERYWHERE else f"{place}:{id}"
