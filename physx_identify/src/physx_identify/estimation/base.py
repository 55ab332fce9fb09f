"""Base: the measured motion of a floating base, by its pose or by an inertial sensor on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physx_core.rotations import (
    from_rotation_vector_rows,
    invert_rows,
    multiply_rows,
    rotate_rows,
    to_rotation_vector_rows,
)
from physx_core.typing import Vector

COORDINATES = ("base x", "base y", "base z", "base roll", "base pitch", "base yaw")
"""Names of the coordinates: along the axes of the world, or of the base where only an inertial
sensor is known; and about the base's own axes."""
_NEAR = 1e-6
"""Step of a central difference."""
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


@dataclass(frozen=True)
class Imu:
    """An inertial sensor on a floating base, whose readings take the place of coordinates.

    Readings are specific force in m/s² and angular velocity in rad/s, along the base's axes, each
    of the period that ends with its sample. All is told in the axes that the base has at a sample,
    as if it were upright there and weighed nothing: torques depend on no other orientation, so no
    drift has any effect.

    Attributes:
        arm: Place of the sensor on the base, in m, shape (3,).
    """

    arm: Vector

    def motion(
        self, readings: Vector, period: float, instant: bool
    ) -> tuple[Vector, Vector, Vector]:
        """Return velocities, velocities at the ends of steps, and accelerations of the base.

        Args:
            readings: Of the samples before, at and after each sample, shape (3, samples, 6).
            period: In s.
            instant: As in `Path`.

        Returns:
            Each of shape (samples, 6); a linear velocity has no effect and is 0.
        """
        force, turning = readings[..., :3], readings[..., 3:]
        place = 1 if instant else 2  # of the readings that tell this step's acceleration
        first, steps = (0, 2) if instant else (1, 1)
        angular = (turning[2] - turning[first]) / (steps * period)
        own = turning[place]
        linear = force[place] - np.cross(angular, self.arm)
        linear -= np.cross(own, np.cross(own, self.arm))
        if not instant:  # as it is in the axes where the step begins
            linear = rotate_rows(from_rotation_vector_rows(period * own), linear)
        velocities, ends = (
            np.concatenate([np.zeros_like(each), each], axis=1) for each in (turning[1], own)
        )
        return velocities, ends, np.concatenate([linear, angular], axis=1)

    def slopes(self, readings: Vector, period: float, instant: bool) -> tuple[Vector, Vector]:
        """Return derivatives of velocities and accelerations, each (3, samples, 6, readings)."""
        by_v, by_a = np.zeros((2, *readings.shape, 6))
        for place in range(3):
            for number in range(6):
                change = np.zeros_like(readings)
                change[place, :, number] = _NEAR
                ahead = self.motion(readings + change, period, instant)
                behind = self.motion(readings - change, period, instant)
                by_v[place, :, :, number] = (ahead[0] - behind[0]) / (2 * _NEAR)
                by_a[place, :, :, number] = (ahead[2] - behind[2]) / (2 * _NEAR)
        return by_v, by_a
