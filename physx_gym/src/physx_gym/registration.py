"""The environments of physx in Gymnasium's registry."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium

_HOMES = {
    "Cartpole": "cartpole:CartpoleEnv",
    "Acrobot": "acrobot:AcrobotEnv",
    "Ant": "ant:AntEnv",
    "Quadruped": "quadruped:QuadrupedEnv",
    "ArmReach": "arm_reach:ArmReachEnv",
    "PushBox": "push_box:PushBoxEnv",
}
_SOLVED = {"Cartpole": 475.0, "Acrobot": -100.0}


def register() -> None:
    """Register ``physx/<Name>-v0`` for each environment; none is imported before it is made.

    ``import physx_gym`` calls it, as is the custom of Gymnasium's packages.
    """
    for name, home in _HOMES.items():
        identity = f"physx/{name}-v0"
        if identity in gymnasium.registry:
            continue
        gymnasium.register(
            identity,
            entry_point=f"physx_gym.environments.{home}",
            vector_entry_point=partial(make_vector, identity),
            reward_threshold=_SOLVED.get(name),
        )


def make_vector(identity: str, num_envs: int, **options: Any) -> Any:
    """Return a vector environment whose environments run in client processes.

    Args:
        identity: Id of the environment.
        num_envs: How many.
        options: ``processes``, ``autoreset_mode``, ``copy`` and ``timeout`` of `ParallelVectorEnv`;
            the rest is for each environment.
    """
    from physx_gym.vector.vector_env import ParallelVectorEnv

    names = ("processes", "autoreset_mode", "copy", "timeout")
    own = {name: options.pop(name) for name in names if name in options}
    return ParallelVectorEnv(identity, num_envs, env_kwargs=options, **own)
