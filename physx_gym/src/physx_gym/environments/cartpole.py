"""Cartpole: a pole on a cart, to be kept upright."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from physx_core.typing import Vector
from physx_gym.env.pipeline_env import Info
from physx_gym.environments import limits
from physx_gym.environments.one_motor import OneMotorEnv

FARTHEST = 2.2
STEEPEST = math.radians(12.0)


class CartpoleEnv(OneMotorEnv):
    """Keep a pole upright by pushing the cart that it stands on: ``physx/Cartpole-v0``.

    Action: push to the left, not at all, or to the right, with 10 N; or, if `continuous`, the push
    as a fraction of that. Observation, shape (4,): position of the cart in m, angle of the pole in
    rad, and their velocities. Reward: 1 for every step. An episode terminates if the pole leans by
    more than 12 degrees or the cart is more than 2.2 m away, and is truncated after 500 steps of
    20 ms, each a single physics step, as in Gymnasium's CartPole-v1.

    The task is that of A. G. Barto, R. S. Sutton and C. W. Anderson, "Neuronlike adaptive elements
    that can solve difficult learning control problems", 1983.
    """

    MODEL, JOINT, STRENGTH = "cartpole", "slider", 10.0
    PERIOD, STEP, DURATION = 0.02, 0.02, 10.0

    def _initialize_observation_space(self) -> None:
        fastest = limits.joint_velocities(self.simulator)
        self.observation_space = limits.box([2.5, 2 * math.pi], fastest)

    def _sample_state(self) -> tuple[Vector, Vector]:
        state = self.np_random.uniform(-0.05, 0.05, 4)
        return state[:2], state[2:]

    def refresh_observation(self, measurement: Mapping[str, Any]) -> None:
        """Observe positions and velocities."""
        state = measurement["states"]["agent"]
        self.observation[:2], self.observation[2:] = state["q"], state["v"]

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the pole has fallen or the cart has gone too far."""
        place, angle, _, _ = self.observation.tolist()
        return abs(place) > FARTHEST or abs(angle) > STEEPEST, False

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return 1 for every step."""
        return 1.0
