"""Acrobot: two links that swing up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_gym.env.pipeline_env import Info
from physx_gym.environments import limits
from physx_gym.environments.one_motor import OneMotorEnv

HEIGHT = 1.0


class AcrobotEnv(OneMotorEnv):
    """Swing two 1 m links above a bar 1 m over the shoulder: ``physx/Acrobot-v0``.

    Only the elbow is driven. Action: a torque of -1, 0 or 1 N m; or, if `continuous`, any number
    in between. Observation, shape (6,): cosine and sine of the shoulder's angle, which is 0 if the
    link hangs down, and of the elbow's, then both velocities in rad/s. Reward: -1 for every step,
    but 0 for the last. An episode terminates above the bar, and is truncated after 500 steps of
    0.2 s.

    The task is that of R. S. Sutton, "Generalization in reinforcement learning", 1996.
    """

    MODEL, JOINT, STRENGTH = "acrobot", "elbow", 1.0
    PERIOD, STEP, DURATION = 1.25e-2, 0.2, 100.0

    def _initialize_observation_space(self) -> None:
        self.observation_space = limits.box(np.ones(4), limits.joint_velocities(self.simulator))

    def _sample_state(self) -> tuple[Vector, Vector]:
        state = self.np_random.uniform(-0.1, 0.1, 4)
        return state[:2], state[2:]

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe angles and velocities."""
        state = measurement["states"]["agent"]
        np.cos(state["q"], out=self.observation[0:4:2])
        np.sin(state["q"], out=self.observation[1:4:2])
        self.observation[4:] = state["v"]

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the end is above the bar."""
        cos, sin, elbow_cos, elbow_sin, *_ = self.observation.tolist()
        height = -cos - (cos * elbow_cos - sin * elbow_sin)
        return height > HEIGHT, False

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return -1, but 0 for the last step."""
        return 0.0 if terminated else -1.0
