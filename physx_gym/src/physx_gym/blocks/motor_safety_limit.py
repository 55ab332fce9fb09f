"""Controller block that limits torques to keep joints within soft limits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy import add, maximum, minimum, multiply, subtract

from physx_core.typing import Vector
from physx_gym.blocks.block import ControllerBlock
from physx_gym.blocks.motor_joints import MotorJoints

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


class MotorSafetyLimit(ControllerBlock):
    """Limits the motors' torques to keep joints within soft limits of positions and velocities.

    The closer a joint is to a soft limit of its position, the slower it may move toward it: its
    velocity must be between ``-kp * (position - soft_limit)`` for the two limits and within
    `soft_velocity_max`. The torque may be at most ``kd`` times the distance from these velocities;
    beyond a limit, it pushes back. This is the scheme of the PR2's controllers, see
    http://wiki.ros.org/pr2_controller_manager/safety_limits. The motors' own limits apply as well.

    Its action: torques, like that of the environment below.

    Attributes:
        joints: The motors' joints.
        soft_lower: Soft lower limits of the positions, shape (motors,), in rad or m.
        soft_upper: Soft upper limits, likewise.
    """

    def __init__(
        self,
        name: str,
        env: PipelineEnv,
        *,
        update_ratio: int = 1,
        kp: Any,
        kd: Any,
        soft_position_margin: Any = 0.0,
        soft_velocity_max: Any = np.inf,
    ) -> None:
        """Limit the torques of an environment's motors.

        Args:
            name: Name within the pipeline.
            env: The environment below.
            update_ratio: See `Block`.
            kp: Velocity per unit of distance from a soft limit, in 1/s; this and all options below:
                a number, or one for each motor.
            kd: Torque at the joint per unit of velocity, in N m s/rad or N s/m.
            soft_position_margin: Distance of the soft limits from the joints' limits, in rad or m.
            soft_velocity_max: Highest velocity, in rad/s or m/s.

        Raises:
            ConfigError: If an option is invalid, or the environment lacks motors or encoders.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        self.kp, self.kd = kp, kd
        self.soft_position_margin = soft_position_margin
        self.soft_velocity_max = soft_velocity_max
        self.refresh_connection()

    def connect(self) -> None:
        """Read the limits of the environment's motors."""
        self.joints = joints = MotorJoints(self.env, f'MotorSafetyLimit "{self.name}"')
        self.action_space = self.env.action_space
        kp, kd = (joints.option(name, getattr(self, name), positive=True) for name in ("kp", "kd"))
        margin = joints.option("soft_position_margin", self.soft_position_margin)
        fastest = joints.option("soft_velocity_max", self.soft_velocity_max)
        self.soft_lower, self.soft_upper = joints.lower + margin, joints.upper - margin
        kd = kd / np.abs(joints.reduction)
        signs = np.sign(joints.reduction)
        # If the shaft turns the other way, the joint's upper limit is the shaft's lower one.
        limits = np.sort(np.array([self.soft_lower, self.soft_upper]) * signs, axis=0)
        self._encoders = joints.encoders
        self._scaled, gains = self._encoders.buffer(), self._encoders.buffer()
        gains[:] = np.array([kp * kd, kd]) * signs
        self._room = np.zeros((2, len(kp)))
        self._parts = (*self._scaled, *(kp * kd * limits), *self._room)
        self._measured = (self._encoders.values, gains, self._scaled)
        self._most = np.array([kd * fastest] * 2)
        self._least = -self._most
        self._bounded = bool(np.isfinite(self._most).any())

    def compute_command(self, action: Vector, command: Vector) -> None:
        """Write the limited torques, shape (motors,), in N m or N."""
        if self._encoders.is_copy:
            self._encoders.refresh()
        positions, velocities, lower, upper, backward, forward = self._parts
        multiply(*self._measured)
        if self._bounded:
            subtract(lower, positions, backward)
            subtract(upper, positions, forward)
            minimum(self._room, self._most, out=self._room)
            maximum(self._room, self._least, out=self._room)
            subtract(backward, velocities, backward)
            subtract(forward, velocities, forward)
        else:
            add(positions, velocities, positions)
            subtract(lower, positions, backward)
            subtract(upper, positions, forward)
        maximum(action, backward, out=command)
        minimum(command, forward, out=command)
