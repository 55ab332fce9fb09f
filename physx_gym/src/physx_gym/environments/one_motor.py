"""Robots with a single motor, which can be driven with the arrow keys."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.simulation import Motor, Robot, World
from physx_core.typing import Vector
from physx_gym.env.robot_env import RobotEnv
from physx_gym.simulator.simulator import Simulator

_KEYS = {"Left": 0, "Right": 2}


class OneMotorEnv(RobotEnv):
    """A robot whose only motor pushes with full strength in either direction, or rests.

    Action: 0, 1 and 2 push in the negative direction, not at all, and in the positive direction;
    or, if `continuous`, a number from -1 to 1 is the fraction of the motor's strength.

    Attributes:
        continuous: Whether the action is a number instead of a choice.
        strength: Largest torque or force of the motor, in N m or N.
    """

    def __init__(
        self,
        robot: str,
        joint: str,
        strength: float,
        period: float,
        step_dt: float,
        /,
        *,
        backend: Any,
        continuous: bool,
        **options: Any,
    ) -> None:
        """Create the environment.

        Args:
            robot: The robot; it does not collide.
            joint: The joint that the motor drives.
            strength: Largest torque or force of the motor, in N m or N.
            period: Duration of a physics step, in s.
            step_dt: Duration of a step, in s.
            backend: Reference of the engine.
            continuous: Whether the action is a number instead of a choice.
            options: Options of `RobotEnv`.
        """
        self.continuous, self.strength = continuous, strength
        world = World([Robot(robot, collisions="none")], period=period)
        motors = [Motor(joint=joint, max_torque=strength)]
        simulator = Simulator(world, backend=backend, motors=motors, sensors=())
        super().__init__(simulator, step_dt, **options)

    def _initialize_action_space(self) -> None:
        self.action_space = spaces.Box(-1.0, 1.0, (1,)) if self.continuous else spaces.Discrete(3)

    def compute_command(self, action: Any, command: Vector) -> None:
        """Push."""
        command[0] = self.strength * (action[0] if self.continuous else int(action) - 1)

    def _key_to_action(
        self, key: str | None, obs: Any, reward: float | None, **kwargs: Any
    ) -> Any | None:
        choice = _KEYS.get(key or "", 1)
        return np.array([choice - 1.0], np.float32) if self.continuous else choice
