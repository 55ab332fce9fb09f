"""Robots with a single motor, which can be driven with the arrow keys."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core.typing import Vector
from physx_gym.env.robot_env import RobotEnv
from physx_gym.simulator.simulator import Simulator
from physx_sim import Motor, Robot, World

_KEYS = {"Left": 0, "Right": 2}


class OneMotorEnv(RobotEnv):
    """A robot whose only motor pushes with full strength in either direction, or rests.

    Action: 0, 1 and 2 push in the negative direction, not at all, and in the positive direction;
    or, if `continuous`, a number from -1 to 1 is the fraction of the motor's strength.

    Attributes:
        MODEL: Name of the robot; it does not collide.
        JOINT: The joint that the motor drives.
        STRENGTH: Largest torque or force of the motor, in N m or N.
        PERIOD: Duration of a physics step, in s.
        STEP: Duration of a step of the environment, in s.
        DURATION: Time after which an episode is truncated, in s.
        continuous: Whether the action is a number instead of a choice.
    """

    MODEL: ClassVar[str]
    JOINT: ClassVar[str]
    STRENGTH: ClassVar[float]
    PERIOD: ClassVar[float]
    STEP: ClassVar[float]
    DURATION: ClassVar[float]

    constants: ClassVar[tuple[str, ...]] = ("continuous",)

    def __init__(self, *, backend: Any = "dart", continuous: bool = False, **options: Any) -> None:
        """Create the environment.

        Args:
            backend: Reference of the engine.
            continuous: Whether the action is a number instead of a choice.
            options: Options of `RobotEnv`: ``render_mode``, ``debug``, ``simulation_duration_max``.
        """
        self.continuous = continuous
        world = World([Robot(self.MODEL, collisions="none")], period=self.PERIOD)
        motors = [Motor(joint=self.JOINT, max_torque=self.STRENGTH)]
        simulator = Simulator(world, backend=backend, motors=motors, sensors=())
        super().__init__(
            simulator, self.STEP, **{"simulation_duration_max": self.DURATION, **options}
        )

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (1,)) if self.continuous else spaces.Discrete(3)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Push."""
        command[0] = self.STRENGTH * (action[0] if self.continuous else int(action) - 1)

    def _key_to_action(
        self, key: str | None, obs: Any, reward: float | None, **kwargs: Any
    ) -> Any | None:
        choice = _KEYS.get(key or "", 1)
        return np.array([choice - 1.0], np.float32) if self.continuous else choice
