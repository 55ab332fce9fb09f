"""Proportional-derivative controller block whose targets move within bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces
from numpy import add, maximum, minimum, multiply, subtract

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.blocks.block import ControllerBlock
from physx_gym.blocks.motor_joints import MotorJoints
from physx_gym.blocks.targets import Targets

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


class PDController(ControllerBlock):
    """Drives the motors' joints to targets, whose accelerations are the action.

    In each period, the targets move as described in `Targets`, and the torques of the motors are
    ``kp * ((target - position) + kd * (target_velocity - velocity)) / reduction``, clipped to the
    motors' limits. Positions and velocities are measured by encoders. An episode begins with the
    targets at the joints' positions.

    Its action: accelerations, shape (motors,), in rad/s² or m/s². Its state: positions and
    velocities of the targets, shape (2, motors).

    Attributes:
        joints: The motors' joints.
        lower: Lowest positions of the targets, shape (motors,), in rad or m.
        upper: Highest positions, likewise.
        max_velocity: Highest velocities of the targets, in rad/s or m/s.
        max_acceleration: Highest accelerations of the targets, in rad/s² or m/s².
        targets: The targets.
    """

    memory: ClassVar[tuple[str, ...]] = ("target_state",)

    def __init__(
        self,
        name: str,
        env: PipelineEnv,
        *,
        update_ratio: int = 1,
        kp: Any,
        kd: Any,
        joint_position_margin: Any = 0.0,
        joint_velocity_limit: Any = np.inf,
        joint_acceleration_limit: Any = None,
    ) -> None:
        """Control the motors of an environment whose action is their torques.

        Args:
            name: Name within the pipeline.
            env: The environment below.
            update_ratio: See `Block`.
            kp: Torque at the joint per unit of position error, in N m/rad or N/m; this and all
                options below: a number, or one for each motor.
            kd: Damping per unit of `kp`, in s.
            joint_position_margin: Distance of the targets from the joints' limits, in rad or m.
            joint_velocity_limit: Highest velocity of the targets, in rad/s or m/s; the limits of
                joints and motors apply as well.
            joint_acceleration_limit: Highest acceleration of the targets, in rad/s² or m/s²; None:
                enough to reverse the highest velocity within a step of the environment.

        Raises:
            ConfigError: If an option is invalid, or the environment lacks motors or encoders.
        """
        super().__init__(name, env, update_ratio=update_ratio)
        self.kp, self.kd = kp, kd
        self.joint_position_margin = joint_position_margin
        self.joint_velocity_limit = joint_velocity_limit
        self.joint_acceleration_limit = joint_acceleration_limit
        self._gain_factors: Any = np.ones((2, 1))
        self.refresh_connection()

    def connect(self) -> None:
        """Read the limits of the environment's motors.

        Raises:
            ConfigError: If the environment's action is not the torques of motors, a joint has no
                encoder, or neither a velocity nor an acceleration limit, or an option is invalid.
        """
        where = f'PDController "{self.name}"'
        self.joints = joints = MotorJoints(self.env, where)
        kp, kd = joints.option("kp", self.kp, positive=True), joints.option("kd", self.kd)
        margin = joints.option("joint_position_margin", self.joint_position_margin)
        fastest = joints.option("joint_velocity_limit", self.joint_velocity_limit)
        self.max_velocity = np.minimum(joints.max_velocity, fastest)
        most = self.joint_acceleration_limit
        if most is None:
            most = 2 * self.max_velocity / self.env.step_dt
            if not np.isfinite(most).all():
                raise ConfigError(
                    f"{where}: the velocities of some joints are not limited. Set "
                    "joint_velocity_limit or joint_acceleration_limit."
                )
        self.max_acceleration = joints.option("joint_acceleration_limit", most, positive=True)
        self.lower, self.upper = joints.lower + margin, joints.upper - margin
        most = self.max_acceleration
        self.action_space = spaces.Box(-most, most, dtype=np.float64)
        self.targets = Targets(self.lower, self.upper, self.max_velocity, self.max_acceleration)
        self.target_state = self.targets.state
        self._nominal = kp / joints.reduction, kp / joints.reduction * kd
        self._encoders, self._errors = joints.encoders, np.zeros((2, len(kp)))
        self._gains = self._gain_factors * self._nominal
        self._least, self._most = -joints.max_torque, joints.max_torque
        # Row by row, as the measurements may have a different memory layout.
        targets = (self.targets.positions, self.targets.velocities)
        self._rows = (*targets, *self._encoders.values, *self._errors)

    def scale_gains(self, position: Any, velocity: Any) -> None:
        """Multiply the original gains by factors from now on.

        Args:
            position: Factor of the torque per unit of position error: a number, or one for each
                motor.
            velocity: Factor of the torque per unit of velocity error, likewise.
        """
        self._gain_factors = np.array(np.broadcast_arrays(position, velocity), np.float64)
        self._gain_factors = self._gain_factors.reshape(2, -1)
        self._gains[:] = self._gain_factors * self._nominal

    def setup(self) -> None:
        """Compute the periods."""
        super().setup()
        self.targets.set_period(self.period)

    def begin(self) -> None:
        """Begin with the targets at the joints' positions."""
        self._encoders.refresh()
        self.targets.start(*self._encoders.values)

    @property
    def fieldnames(self) -> list[str]:
        """Names of the accelerations."""
        return [f"targetAcceleration.{name}" for name in self.joints.names]

    @property
    def state_space(self) -> spaces.Box:
        """Space of the targets' positions and velocities."""
        return spaces.Box(*self.targets.bounds, dtype=np.float64)

    def get_state(self) -> Vector:
        """Return positions and velocities of the targets, shape (2, motors)."""
        return self.targets.pair

    @property
    def state_fieldnames(self) -> list[list[str]]:
        """Names of the targets' positions and velocities."""
        names = self.joints.names
        return [[f"{kind}.{name}" for name in names] for kind in ("target", "targetVelocity")]

    def compute_command(self, action: Vector, command: Vector) -> None:
        """Move the targets, and write the torques, shape (motors,), in N m or N."""
        self.targets.step(action)
        if self._encoders.is_copy:
            self._encoders.refresh()
        positions, velocities, seen, seen_velocities, errors, velocity_errors = self._rows
        subtract(positions, seen, errors)
        subtract(velocities, seen_velocities, velocity_errors)
        multiply(self._errors, self._gains, self._errors)
        add(errors, velocity_errors, command)
        minimum(command, self._most, out=command)
        maximum(command, self._least, out=command)
