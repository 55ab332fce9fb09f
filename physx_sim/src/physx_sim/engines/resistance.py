"""Resistance of a robot's joints: damping, Coulomb friction, and springs."""

from __future__ import annotations

from typing import Self

import numpy as np

from physx_core.typing import Vector
from physx_sim.engines.models.parts import MovableBody


class Resistance:
    """Damping, friction, springs, and rotors of a robot, each of shape (nv,), 0 for its base.

    Attributes:
        damping: In N m s/rad or N s/m.
        friction: In N m or N.
        stiffness: Stiffness of the springs, in N m/rad or N/m.
        rest: Rest positions of the springs, in rad or m.
        armature: Inertia of the rotors, in kg m² or kg.
        table: All five as rows, shape (5, nv).
    """

    def __init__(self, table: Vector) -> None:
        """Keep the rows, in the order above.

        Args:
            table: Shape (5, nv).
        """
        self.table = table
        self.damping, self.friction, self.stiffness, self.rest, self.armature = table
        self._smooth = bool(self.damping.any() or self.stiffness.any())
        self._any = self._smooth or bool(self.friction.any())

    @classmethod
    def of(cls, movable: MovableBody) -> Self:
        """Return the resistance of a robot or object."""
        base = 0 if movable.fixed_base else 6
        table = np.zeros((5, base + len(movable.model.joints)))
        for column, joint in zip(table.T[base:], movable.model.joints, strict=True):
            column[:] = (
                joint.damping,
                joint.friction,
                joint.stiffness,
                joint.rest,
                joint.armature,
            )
        return cls(table)

    def torques(self, positions: Vector, velocities: Vector) -> Vector | float:
        """Return the torques that resist a motion, shape (..., nv), or 0 if there are none."""
        if not self._any:
            return 0.0
        found: Vector = self.smooth(positions, velocities) + self.friction * np.sign(velocities)
        return found

    def smooth(self, positions: Vector, velocities: Vector) -> Vector | float:
        """Return the torques of damping and springs only, as in `torques`."""
        if not self._smooth:
            return 0.0
        stretch = positions[..., positions.shape[-1] - velocities.shape[-1] :] - self.rest
        springs = np.where(self.stiffness, self.stiffness * stretch, 0.0)
        found: Vector = self.damping * velocities + springs
        return found
