"""What an engine implements for one robot or object."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from physx_core.rotations import Triple, cross, rotate_back
from physx_core.typing import Vector
from physx_dart.shared.parts import Mover
from physx_dart.shared.resistance import Resistance


class RobotEngine(ABC):
    """One robot or object in an engine. Vectors are in the convention of `physx_core`'s backends.

    Attributes:
        mover: What it is.
        model: What its file says.
        fixed_base: Whether the root link is welded to the world.
        nq: Length of its positions.
        nv: Length of its velocities.
        base: Degrees of freedom of its base: 0 or 6.
        resistance: What resists the motion of its joints.
    """

    def __init__(self, mover: Mover) -> None:
        self.mover, self.model = mover, mover.model
        self.fixed_base = mover.fixed_base
        joints = self.model.joints
        self.base = 0 if self.fixed_base else 6
        self.nq = len(joints) + (0 if self.fixed_base else 7)
        self.nv = len(joints) + self.base
        self.resistance = Resistance.of(mover)

    def neutral(self) -> Vector:
        """Return the positions at rest: 0, or the limit nearest to 0; base where it begins."""
        mover = self.mover
        base = [] if self.fixed_base else [*mover.position, *mover.orientation]
        return np.array([*base, *(max(j.lower, min(0.0, j.upper)) for j in self.model.joints)])

    @abstractmethod
    def hold(self, commands: Vector) -> None:
        """Hold commands, shape (joints,), that are within their limits."""

    @abstractmethod
    def positions(self) -> Vector:
        """Return the present positions, shape (nq,), in a vector of its own."""

    @abstractmethod
    def velocities(self) -> Vector:
        """Return the present velocities, shape (nv,), in a vector of its own."""

    @abstractmethod
    def accelerations(self) -> Vector:
        """Return the change of the velocities in the last step by the period, shape (nv,)."""

    @abstractmethod
    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""

    @abstractmethod
    def native(self) -> tuple[Vector, Vector]:
        """Return the state exactly as the engine has it, copied."""

    @abstractmethod
    def set_native(self, positions: Vector, velocities: Vector) -> None:
        """Set the state to what `native` returned."""

    @abstractmethod
    def speed(self) -> float:
        """Return the length of the velocities; NaN or inf where the state is broken."""

    @abstractmethod
    def can_move(self, link: int) -> bool:
        """Return whether a link, by its place in the model, can move at all."""

    @abstractmethod
    def push(self, link: int, force: Vector, torque: Vector, point: Vector, local: bool) -> None:
        """Add a wrench for the next steps until `release`.

        Args:
            link: Place of the link in the model.
            force: In N, shape (3,), on the point.
            torque: In N m, shape (3,).
            point: In the link's frame, in m.
            local: Whether force and torque are along the link's axes; else along the world's.
        """

    @abstractmethod
    def release(self) -> None:
        """End all wrenches."""


def base_accelerations(
    orientation: Sequence[float], linear: Sequence[float], twist: Vector
) -> Triple:
    """Return the derivative of the linear part of a base's twist, along its own axes, in m/s².

    Args:
        orientation: Quaternion x, y, z, w of the base.
        linear: Acceleration of its origin along the world's axes, in m/s².
        twist: Its linear, then its angular velocity along its own axes; more may follow.
    """
    u, v, w, p, q, r = twist[:6].tolist()
    a, b, c = rotate_back(orientation, *linear)
    x, y, z = cross(p, q, r, u, v, w)
    return a - x, b - y, c - z
