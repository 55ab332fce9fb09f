"""The joints of an environment's motors: their limits, and what encoders say of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.errors import ConfigError, nearest
from physx_core.simulation import Encoder
from physx_core.typing import Vector
from physx_gym.shared_arrays import SharedArrays

if TYPE_CHECKING:
    from physx_gym.env.layers.layer import PipelineEnv


class JointEncoders(SharedArrays):
    """What encoders say of joints.

    Attributes:
        values: Positions in rad or m, and velocities in rad/s or m/s, shape (2, joints); where the
            encoders are those of the joints in their order, the measurement itself.
        is_copy: Whether they are a copy of the measurement, so that `refresh` has to be called.
    """

    def __init__(self, env: PipelineEnv, joints: Sequence[str], purpose: str) -> None:
        """Find the encoders of joints.

        Args:
            env: The environment whose sensors they are.
            joints: Names of the joints.
            purpose: What needs them, for an error.

        Raises:
            ConfigError: A joint has no encoder.
        """
        encoders = [each for each in env.simulator.sensors if type(each) is Encoder]
        known = [each.joint for each in encoders]
        for joint in joints:
            if joint not in known:
                raise ConfigError(
                    f'{purpose} needs an Encoder on the joint "{joint}".{nearest(joint, known)} '
                    "Give one to the simulator's sensors."
                )
        places = [known.index(joint) for joint in joints]
        ratios = np.array([encoders[place].reduction for place in places])
        self._measured: Vector = env.simulator.sensed["Encoder"]
        self._places, self._scales = np.array(places, np.intp), np.array([1 / ratios] * 2)
        self.is_copy = places != list(range(len(encoders))) or bool((ratios != 1).any())
        self.values = np.zeros((2, len(places))) if self.is_copy else self._measured

    def refresh(self) -> None:
        """Bring the values to the present."""
        if self.is_copy:
            np.take(self._measured, self._places, 1, self.values, "clip")
            np.multiply(self.values, self._scales, self.values)

    def buffer(self) -> Vector:
        """Return a new array like the values, in the same order in memory.

        To calculate with arrays of different orders takes three times as long.
        """
        shape = self.values.shape
        if self.values.flags.c_contiguous:
            return np.zeros(shape)
        return np.zeros(shape[::-1]).T


class MotorJoints(SharedArrays):
    """The joints that an environment's motors drive, in the motors' order; all of shape (motors,).

    Attributes:
        names: Names of the joints.
        lower: Lowest positions, in rad or m.
        upper: Highest positions.
        max_velocity: Highest velocities, in rad/s or m/s.
        max_torque: Highest torques of the motors' shafts, in N m or N.
        reduction: Turns of the motor for one of the joint.
        encoders: What encoders say of them.
    """

    def __init__(self, env: PipelineEnv, purpose: str) -> None:
        """Find the joints of an environment's motors.

        Raises:
            ConfigError: There is no motor, or a joint has no encoder.
        """
        motors, layout = env.simulator.motors, env.simulator.layout
        if not motors:
            raise ConfigError(f"{purpose} needs motors, but the simulator has none.")
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


def per_motor(where: str, count: int, option: str, given: Any, *, positive: bool = False) -> Vector:
    """Return an option as one number for each motor; infinite ones are allowed.

    Raises:
        ConfigError: It is neither a number nor one for each motor, or is negative or not a number.
    """
    try:
        values = np.broadcast_to(np.asarray(given, np.float64), (count,)).copy()
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{where}: {option} is {given!r} but must be a number, or one for each of the {count} "
            "motors."
        ) from error
    if not (values > 0 if positive else values >= 0).all():
        limit = "above 0" if positive else "0 or above"
        raise ConfigError(f"{where}: {option} is {given!r} but must be {limit}.")
    return values
