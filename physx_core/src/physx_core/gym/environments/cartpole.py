"""A pole on a cart, to be kept upright."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.gym.environments import limits
from physx_core.gym.layer import Info
from physx_core.gym.robot_env import RobotEnv
from physx_core.gym.simulator import Simulator
from physx_core.interfaces.backend import Vector
from physx_core.motors import Motor
from physx_core.world import Robot, World

FORCE = 10.0
FARTHEST = 2.2
STEEPEST = math.radians(12.0)
_KEYS = {"Left": 0, "Right": 2}


class CartpoleEnv(RobotEnv):
    """Keep a pole upright by pushing the cart on which it stands: ``physx/Cartpole-v0``.

    Action: push to the left, not at all, or to the right, with 10 N; or, if `continuous`, the push
    as a share of that. Observation, shape (4,): position of the cart in m, angle of the pole in
    rad, and their velocities. Reward: 1 for every step. It terminates where the pole leans by more
    than 12 degrees or the cart is more than 2.2 m away, and is truncated after 500 steps of 20 ms.

    The task is that of A. G. Barto, R. S. Sutton and C. W. Anderson, "Neuronlike adaptive elements
    that can solve difficult learning control problems", 1983.
    """

    def __init__(self, *, backend: Any = "dart", continuous: bool = False, **options: Any) -> None:
        """Make the environment.

        Args:
            backend: Reference of the engine.
            continuous: Whether the push is a number rather than a choice.
            options: Of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        self.continuous = continuous
        world = World([Robot("cartpole", collisions="none")], period=1e-2)
        motors = [Motor(joint="slider", max_torque=FORCE)]
        options = {"simulation_duration_max": 10.0, **options}
        simulator = Simulator(world, backend=backend, motors=motors, sensors=())
        super().__init__(simulator, 0.02, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (1,)) if self.continuous else spaces.Discrete(3)

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

    def compute_command(self, action: Any, command: Vector) -> None:
        """Push the cart."""
        command[0] = FORCE * action[0] if self.continuous else FORCE * (int(action) - 1)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the pole fell or the cart left."""
        place, angle, _, _ = self.observation.tolist()
        return abs(place) > FARTHEST or abs(angle) > STEEPEST, False

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return 1 for every step."""
        return 1.0

    def _key_to_action(
        self, key: str | None, obs: Any, reward: float | None, **kwargs: Any
    ) -> Any | None:
        choice = _KEYS.get(key or "", 1)
        return np.array([choice - 1.0], np.float32) if self.continuous else choice
