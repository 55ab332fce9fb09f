"""Quantities of the joints of the controlled robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ComponentNotFoundError
from physx_core.typing import Vector
from physx_gym.tasks.quantities.quantity import Moment, Quantity
from physx_sim.errors import FeatureNotSupportedError


@dataclass(frozen=True)
class JointPositions(Quantity):
    """Positions of joints in rad or m, shape (joints,).

    Attributes:
        joints: Names in the layout; none: those with motors, in the motors' order.
    """

    joints: tuple[str, ...] = ()

    def compute(self, moment: Moment) -> Vector:
        """Return the positions."""
        index, begin = moment.simulator.layout.position_index, moment.robot.positions.start
        return np.asarray(moment.q[_places(moment, self.joints, index, begin)])


@dataclass(frozen=True)
class JointVelocities(Quantity):
    """Velocities of joints in rad/s or m/s, shape (joints,).

    Attributes:
        joints: Names in the layout; none: those with motors, in the motors' order.
    """

    joints: tuple[str, ...] = ()

    def compute(self, moment: Moment) -> Vector:
        """Return the velocities."""
        index, begin = moment.simulator.layout.velocity_index, moment.robot.velocities.start
        return np.asarray(moment.v[_places(moment, self.joints, index, begin)])


@dataclass(frozen=True)
class JointTorques(Quantity):
    """Torques of the motors on their joints in the last physics step, shape (motors,)."""

    def compute(self, moment: Moment) -> Vector:
        """Return the torques in N m or N.

        Raises:
            FeatureNotSupportedError: If the moment is on a trajectory.
        """
        if not moment.is_present:
            raise FeatureNotSupportedError("A trajectory", "torques", ())
        return moment.simulator.robot_state.torques.copy()


@dataclass(frozen=True)
class LimitDistances(Quantity):
    """Distances of the motors' joints to the nearer of their limits, shape (motors,).

    In rad or m; negative beyond a limit; infinite without limits.
    """

    def compute(self, moment: Moment) -> Vector:
        """Return the distances."""
        layout = moment.simulator.layout
        places = [layout.joints.index(motor.joint) for motor in moment.simulator.motors]
        positions = moment.get(JointPositions())
        below, above = positions - layout.lower[places], layout.upper[places] - positions
        return np.asarray(np.minimum(below, above))


def _places(
    moment: Moment, joints: tuple[str, ...], index: dict[str, int], begin: int
) -> NDArray[np.intp]:
    names = joints or tuple(motor.joint for motor in moment.simulator.motors)
    for name in names:
        if name not in index:
            raise ComponentNotFoundError("joint", name, "The simulation", index)
    return np.array([index[name] - begin for name in names], np.intp)
