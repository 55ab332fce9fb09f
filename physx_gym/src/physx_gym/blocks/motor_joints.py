"""Joints that an environment's motors drive: their limits and encoder measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.errors import ConfigError, nearest
from physx_core.typing import Vector
from physx_gym.shared_arrays import SharedArrays
from physx_sim import Encoder

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv


class JointEncoders(SharedArrays):
    """Encoder measurements of joints.

    Attributes:
        values: Positions in rad or m, and velocities in rad/s or m/s, shape (2, joints); the
            measurement itself if the encoders are exactly those of the joints, in order.
        is_copy: Whether the values are a copy of the measurement, so `refresh` must be called.
    """

    def __init__(self, env: PipelineEnv, joints: Sequence[str], purpose: str) -> None:
        """Find the encoders of joints.

        Args:
            env: The environment that has the sensors.
            joints: Names of the joints.
            purpose: What needs the encoders, for error messages.
        """
        encoders = [each for each in env.simulator.sensors if type(each) is Encoder]
        known = [each.joint for each in encoders]
        for joint in joints:
            if joint not in known:
                raise ConfigError(
                    f'{purpose} needs an Encoder on the joint "{joint}".{nearest(joint, known)} '
                    "Add one to the simulator's sensors."
                )
        places = [known.index(joint) for joint in joints]
        ratios = np.array([encoders[place].reduction for place in places])
        self._measured: Vector = env.simulator.sensed["Encoder"]
        self._places, self._scales = np.array(places, np.intp), np.array([1 / ratios] * 2)
        self.is_copy = places != list(range(len(encoders))) or bool((ratios != 1).any())
        self.values = np.zeros((2, len(places))) if self.is_copy else self._measured

    def refresh(self) -> None:
        """Update the values."""
        if self.is_copy:
            np.take(self._measured, self._places, 1, self.values, "clip")
            np.multiply(self.values, self._scales, self.values)

    def buffer(self) -> Vector:
        """Return a new array like the values, with the same memory layout.

        Calculating with arrays of different layouts takes three times as long.
        """
        shape = self.values.shape
        if self.values.flags.c_contiguous:
            return np.zeros(shape)
        return np.zeros(shape[::-1]).T


class MotorJoints(SharedArrays):
    """Joints that are driven by torques, in the order of the motors; all arrays are (motors,).

    Attributes:
        names: Names of the joints.
        lower: Lowest positions, in rad or m.
        upper: Highest positions.
        max_velocity: Highest velocities, in rad/s or m/s.
        max_torque: Highest torques of the motors' shafts, in N m or N.
        reduction: Turns of the motor per turn of the joint.
        encoders: Encoder measurements of the joints.
    """

    def __init__(self, env: PipelineEnv, purpose: str) -> None:
        """Find the joints of an environment's motors.

        Args:
            env: The environment.
            purpose: What needs the motors, for error messages.
        """
        motors, layout = env.simulator.motors, env.simulator.layout
        if not motors:
            raise ConfigError(f"{purpose} needs motors, but the simulator has none.")
        if env.action_space.shape != (len(motors),):
            raise ConfigError(
                f"{purpose}: the environment below takes the action {env.action_space}, not the "
                f"torques of {len(motors)} motors."
            )
        self._purpose = purpose
        self.names = tuple(motor.joint for motor in motors)
        places = [layout.joints.index(name) for name in self.names]
        self.reduction = np.array([motor.reduction for motor in motors])
        ratio = np.abs(self.reduction)
        fastest = np.array([motor.max_velocity for motor in motors]) / ratio
        strongest = np.array([motor.max_torque for motor in motors])
        self.lower, self.upper = layout.lower[places], layout.upper[places]
        self.max_velocity = np.minimum(layout.max_velocity[places], fastest)
        self.max_torque = np.minimum(layout.max_torque[places] / ratio, strongest)
        self.encoders = JointEncoders(env, self.names, purpose)

    def option(self, name: str, given: Any, *, positive: bool = False) -> Vector:
        """Return an option as one number for each motor; it may be infinite."""
        count = len(self.names)
        try:
            values = np.broadcast_to(np.asarray(given, np.float64), (count,)).copy()
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"{self._purpose}: {name} is {given!r} but must be a number, or one for each of "
                f"the {count} motors."
            ) from error
        if not (values > 0 if positive else values >= 0).all():
            limit = "positive" if positive else "at least 0"
            raise ConfigError(f"{self._purpose}: {name} is {given!r} but must be {limit}.")
        return values
