"""Registers physx environments with Gymnasium."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium

_ENTRY_POINTS = {
    "Cartpole": "cartpole:CartpoleEnv",
    "Acrobot": "acrobot:AcrobotEnv",
    "Ant": "ant:AntEnv",
    "Quadruped": "quadruped:QuadrupedEnv",
    "ArmReach": "arm_reach:ArmReachEnv",
    "ArmReachGoal": "arm_reach:ArmReachGoalEnv",
    "PushBox": "push_box:PushBoxEnv",
    "PushBoxGoal": "push_box:PushBoxGoalEnv",
}
_REWARD_THRESHOLDS = {"Cartpole": 475.0, "Acrobot": -100.0}


def register() -> None:
    """Register ``physx/<Name>-v0`` for each environment, without importing any.

    Called by ``import physx_gym``, and so by ``gymnasium.make("physx_gym:physx/Cartpole-v0")``,
    which imports the package.
    """
    for name, place in _ENTRY_POINTS.items():
        id = f"physx/{name}-v0"
        if id in gymnasium.registry:
            continue
        gymnasium.register(
            id,
            entry_point=f"physx_gym.environments.{place}",
            vector_entry_point=partial(make_vector, id),
            reward_threshold=_REWARD_THRESHOLDS.get(name),
        )


_VECTOR_OPTIONS = (
    *("num_processes", "batch_size", "autoreset_mode", "copy", "timeout"),
    *("launcher", "launcher_kwargs", "ip_address", "restarts"),
)


def make_vector(id: str, num_envs: int, **options: Any) -> Any:
    """Return a vector environment whose environments run in separate processes.

    Args:
        id: Id of the environment.
        num_envs: Number of environments.
        options: ``num_processes``, ``batch_size``, ``autoreset_mode``, ``copy``, ``timeout``,
            ``launcher``, ``launcher_kwargs``, ``ip_address`` and ``restarts`` of
            `ParallelVectorEnv`; all others go to each environment.
    """
    from physx_gym.vector.vector_env import ParallelVectorEnv

    own = {name: options.pop(name) for name in _VECTOR_OPTIONS if name in options}
    return ParallelVectorEnv(id, num_envs, env_kwargs=options, **own)
