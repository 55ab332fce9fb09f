"""Two links that swing up."""

from __future__ import annotations

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

TORQUE = 1.0
HEIGHT = 1.0
_KEYS = {"Left": 0, "Right": 2}


class AcrobotEnv(RobotEnv):
    """Swing two links of 1 m above a bar 1 m over the shoulder: ``physx/Acrobot-v0``.

    Only the elbow is driven. Action: a torque of -1, 0 or 1 N m; or, if `continuous`, a number
    between. Observation, shape (6,): cosine and sine of the shoulder's angle, 0 where the link
    hangs down, those of the elbow's, and both velocities in rad/s. Reward: -1 for every step,
    but 0 for the last. It terminates above the bar, and is truncated after 500 steps of 0.2 s.

    The task is that of R. S. Sutton, "Generalization in reinforcement learning", 1996.
    """

    def __init__(self, *, backend: Any = "dart", continuous: bool = False, **options: Any) -> None:
        """Make the environment.

        Args:
            backend: Reference of the engine.
            continuous: Whether the torque is a number rather than a choice.
            options: Of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        self.continuous = continuous
        world = World([Robot("acrobot", collisions="none")], period=1.25e-2)
        motors = [Motor(joint="elbow", max_torque=TORQUE)]
        options = {"simulation_duration_max": 100.0, **options}
        simulator = Simulator(world, backend=backend, motors=motors, sensors=())
        super().__init__(simulator, 0.2, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (1,)) if self.continuous else spaces.Discrete(3)

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

    def compute_command(self, action: Any, command: Vector) -> None:
        """Drive the elbow."""
        command[0] = TORQUE * action[0] if self.continuous else TORQUE * (int(action) - 1)

    def has_terminated(self, info: Info) -> tuple[bool, bool]:
        """Return whether the end is above the bar."""
        cos, sin, elbow_cos, elbow_sin, *_ = self.observation.tolist()
        height = -cos - (cos * elbow_cos - sin * elbow_sin)
        return height > HEIGHT, False

    def compute_reward(self, terminated: bool, info: Info) -> float:
        """Return -1, but 0 for the last step."""
        return 0.0 if terminated else -1.0

    def _key_to_action(
        self, key: str | None, obs: Any, reward: float | None, **kwargs: Any
    ) -> Any | None:
        choice = _KEYS.get(key or "", 1)
        return np.array([choice - 1.0], np.float32) if self.continuous else choice
