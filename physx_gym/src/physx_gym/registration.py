"""Registers physx environments with Gymnasium."""

from __future__ import annotations

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
            vector_entry_point=f"physx_gym.vectors:{id}",
            reward_threshold=_REWARD_THRESHOLDS.get(name),
        )
