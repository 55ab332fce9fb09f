"""The interface that an engine implements for a robot or object."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from physx_core.rotations import Triple, cross, rotate, rotate_back
from physx_core.typing import Vector
from physx_sim.engines.models.parts import MovableBody
from physx_sim.engines.resistance import Resistance


class RobotEngine(ABC):
    """A robot or object in an engine; vectors follow the convention of `physx_core`.

    Attributes:
        movable: Its description.
        model: Its model.
        fixed_base: Whether the root link is welded to the world.
        nq: Length of its positions.
        nv: Length of its velocities.
        base: Degrees of freedom of its base: 0 or 6.
        resistance: Resistance of its joints.
    """

    def __init__(self, movable: MovableBody) -> None:
        self.movable, self.model = movable, movable.model
        self.fixed_base = movable.fixed_base
        joints = self.model.joints
        self.base = 0 if self.fixed_base else 6
        self.nq = len(joints) + (0 if self.fixed_base else 7)
        self.nv = len(joints) + self.base
        self.resistance = Resistance.of(movable)

    def neutral(self) -> Vector:
        """Return the rest positions: those of the model, with the base at its initial pose."""
        movable = self.movable
        base = [] if self.fixed_base else [*movable.position, *movable.orientation]
        return np.concatenate([base, self.model.start])

    @abstractmethod
    def hold(self, commands: Vector) -> None:
        """Hold commands, shape (joints,), already clipped to their limits."""

    @abstractmethod
    def positions(self) -> Vector:
        """Return the current positions, shape (nq,), as a new vector."""

    @abstractmethod
    def velocities(self) -> Vector:
        """Return the current velocities, shape (nv,), as a new vector."""

    @abstractmethod
    def accelerations(self) -> Vector:
        """Return the velocity change in the last step divided by the period, shape (nv,)."""

    @abstractmethod
    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""

    @abstractmethod
    def native(self) -> tuple[Vector, Vector]:
        """Return a copy of the engine's native state."""

    @abstractmethod
    def set_native(self, positions: Vector, velocities: Vector) -> None:
        """Set a state returned by `native`."""

    @abstractmethod
    def speed(self) -> float:
        """Return the norm of the velocities; NaN or inf if the state is not finite."""

    @abstractmethod
    def can_move(self, link: int) -> bool:
        """Return whether a link, given by its index in the model, can move."""

    @abstractmethod
    def push(self, link: int, force: Vector, torque: Vector, point: Vector, local: bool) -> None:
        """Apply a wrench until `release`.

        Args:
            link: Index of the link in the model.
            force: Force at the point, shape (3,), in N.
            torque: Torque, shape (3,), in N m.
            point: Point of application in the link's frame, in m.
            local: Whether force and torque are in the link's frame instead of the world's.
        """

    @abstractmethod
    def release(self) -> None:
        """Remove all wrenches."""


def base_accelerations(
    orientation: Sequence[float], linear: Sequence[float], twist: Vector
) -> Triple:
    """Return the time derivative of the linear part of a base's twist, in its own frame, in m/s².

    Args:
        orientation: Quaternion x, y, z, w of the base.
        linear: Acceleration of its origin in the world frame, in m/s².
        twist: Its linear, then angular velocity in its own frame; further entries are ignored.
    """
    u, v, w, p, q, r = twist[:6].tolist()
    a, b, c = rotate_back(orientation, *linear)
    x, y, z = cross(p, q, r, u, v, w)
    return a - x, b - y, c - z


def twist_change(
    earlier: Sequence[float], before: Vector, now: Sequence[float], after: Vector, period: float
) -> Vector:
    """Return the change of a base's twist in a step divided by the period, shape (6,).

    Args:
        earlier: Quaternion x, y, z, w of the base before the step.
        before: Its velocities before the step: linear in the world frame, angular in its own;
            further entries are ignored.
        now: Quaternion after the step.
        after: Velocities after the step, as in `before`.
        period: Length of the step, in s.
    """
    pace, linear = 1 / period, after[:3].tolist()
    twist = np.array([*rotate_back(now, *linear), *after[3:6].tolist()])
    p, q, r = twist[3:].tolist()
    x, y, z = rotate_back(now, *rotate(earlier, *before[3:6].tolist()))
    change = ((after[:3] - before[:3]) / period).tolist()
    spin = pace * (p - x), pace * (q - y), pace * (r - z)
    return np.array([*base_accelerations(now, change, twist), *spin])
