"""Base: the measured motion of a floating base, as coordinates whose differences are velocities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physx_core.rotations import (
    from_rotation_vector_rows,
    invert_rows,
    multiply_rows,
    to_rotation_vector_rows,
)
from physx_core.typing import Vector

COORDINATES = ("base x", "base y", "base z", "base roll", "base pitch", "base yaw")
"""Names of the coordinates: position in the world; sums of the turns about the base's own axes."""
UNITS = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True)
class Base:
    """Measured orientations of a floating base.

    Angles are sums of the turns from sample to sample, in the base's frame: their differences are
    its angular velocities, as an engine's step turns it. Orientations follow from the measured ones
    by what angles along another path differ from those of the measured one.

    Attributes:
        orientations: Unit quaternions x, y, z, w, shape (samples, 4).
        angles: In rad, shape (samples, 3).
    """

    orientations: Vector
    angles: Vector

    @classmethod
    def of(cls, orientations: Vector) -> Base:
        """Return what was measured, from unit quaternions, shape (samples, 4)."""
        turns = multiply_rows(invert_rows(orientations[:-1]), orientations[1:])
        angles = np.cumsum(to_rotation_vector_rows(turns), axis=0)
        return cls(orientations, np.concatenate([np.zeros((1, 3)), angles]))

    def turned(self, angles: Vector) -> Vector:
        """Return the orientations of other angles, shape (samples, 3)."""
        turns = from_rotation_vector_rows(angles - self.angles)
        found: Vector = multiply_rows(self.orientations, turns)
        return found
