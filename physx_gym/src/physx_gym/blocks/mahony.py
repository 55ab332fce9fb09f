"""Attitude from angular velocity and acceleration: the explicit complementary filter.

R. Mahony, T. Hamel, J.-M. Pflimlin: "Nonlinear Complementary Filters on the Special Orthogonal
Group", IEEE Transactions on Automatic Control 53 (5), 2008. An acceleration whose magnitude differs
from gravity says little about which way is up: its weight is ``1 - 2 * abs(a² / g² - 1)``, at least
0. Quaternions are x, y, z, w.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from physx_core.rotations import (
    IDENTITY,
    Quaternion,
    cross_rows,
    from_rotation_vector_rows,
    multiply_rows,
    rotate_back_rows,
)
from physx_core.typing import Vector

_WEIGHTLESS = 1e-3
"""Acceleration, in m/s², below which it says nothing about which way is up."""

_SMALL = 0.0025
"""Square of an angle, in rad², below which three terms of the tangent series suffice for 1e-9."""

_UP = np.array([0.0, 0.0, 1.0])


class Gains(NamedTuple):
    """Coefficients of the filter, computed once.

    Attributes:
        turn: Half the rotation in a period for an acceleration perpendicular to up, in rad.
        bias: Change of the bias in a period for such an acceleration, in rad/s.
        half: Half the period, in s.
        gravity: Square of gravity, in m²/s⁴.
    """

    turn: float
    bias: float
    half: float
    gravity: float

    @classmethod
    def of(cls, kp: float, ki: float, dt: float, g: float) -> Self:
        """Return the coefficients of a filter.

        Args:
            kp: How fast the attitude follows the acceleration, in rad/s.
            ki: How fast the bias follows it, in rad/s².
            dt: The period, in s.
            g: Gravity, in m/s².
        """
        return cls(0.5 * dt * kp, dt * ki, 0.5 * dt, g * g)


def advance(state: Sequence[float], measured: Sequence[float], gains: Gains) -> tuple[float, ...]:
    """Return the state of one filter one period later, in plain numbers.

    Args:
        state: Quaternion, rates without their bias, bias, and last measured rates, in rad/s: 13
            numbers.
        measured: Rates in rad/s and accelerations in m/s², 6 numbers.
        gains: Coefficients of the filter.
    """
    x, y, z, w, _, _, _, bx, by, bz, px, py, pz = state
    gx, gy, gz, ax, ay, az = measured
    turn, learn, half, gravity = gains
    middle = 0.5 * half  # the rates are the mean of now and last time
    ox = middle * (px + gx) - half * bx
    oy = middle * (py + gy) - half * by
    oz = middle * (pz + gz) - half * bz
    square = ax * ax + ay * ay + az * az
    weight = gravity - 2 * abs(square - gravity)
    if weight > 0.0:
        weight /= gravity * math.sqrt(square)
        ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        ex, ey, ez = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
        gain = turn * weight
        ox, oy, oz = ox + gain * ex, oy + gain * ey, oz + gain * ez
        gain = learn * weight
        bx, by, bz = bx - gain * ex, by - gain * ey, bz - gain * ez
    # The rotation by twice o, as (tan(|o|) o / |o|, 1): its length does not matter.
    square = ox * ox + oy * oy + oz * oz
    if square < _SMALL:
        ratio = 1 + square * (1 / 3 + square * (2 / 15))
    else:
        angle = math.sqrt(square)
        ratio = math.tan(angle) / angle
    ox, oy, oz = ox * ratio, oy * ratio, oz * ratio
    qx = x + w * ox + y * oz - z * oy
    qy = y + w * oy + z * ox - x * oz
    qz = z + w * oz + x * oy - y * ox
    qw = w - x * ox - y * oy - z * oz
    scale = 1.0 / math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    qx, qy, qz, qw = qx * scale, qy * scale, qz * scale, qw * scale
    return qx, qy, qz, qw, gx - bx, gy - by, gz - bz, bx, by, bz, gx, gy, gz


def advance_rows(states: Vector, measured: Vector, gains: Gains) -> Vector:
    """Return the states of many filters one period later, like `advance`.

    Args:
        states: Shape (n, 13).
        measured: Shape (n, 6).
        gains: See `advance`.
    """
    attitudes, biases, last = states[:, :4], states[:, 7:10], states[:, 10:]
    rates, accelerations = measured[:, :3], measured[:, 3:]
    gravity, half = gains.gravity, gains.half
    squares = np.einsum("ij,ij->i", accelerations, accelerations)
    weights = np.maximum(gravity - 2 * np.abs(squares - gravity), 0.0)
    weights /= np.where(weights > 0, gravity * np.sqrt(squares), 1.0)
    up = rotate_back_rows(attitudes, np.broadcast_to(_UP, rates.shape))
    errors = cross_rows(accelerations, up) * weights[:, None]
    halves = half * (0.5 * (last + rates) - biases) + gains.turn * errors
    attitudes = multiply_rows(attitudes, from_rotation_vector_rows(2 * halves))
    attitudes /= np.sqrt(np.einsum("ij,ij->i", attitudes, attitudes))[:, None]
    biases = biases - gains.bias * errors
    return np.concatenate([attitudes, rates - biases, biases, rates], axis=1)


def attitude_from_gravity(ax: float, ay: float, az: float) -> Quaternion:
    """Return the attitude without twist for which the acceleration (ax, ay, az) points up."""
    length = math.sqrt(ax * ax + ay * ay + az * az)
    if length <= _WEIGHTLESS:
        return IDENTITY
    ax, ay, az = ax / length, ay / length, az / length
    if az < -1 + 1e-9:
        return 1.0, 0.0, 0.0, 0.0
    w = 1 + az
    scale = 1.0 / math.sqrt(ax * ax + ay * ay + w * w)
    return ay * scale, -ax * scale, 0.0, w * scale


def remove_twist(x: float, y: float, z: float, w: float) -> Quaternion:
    """Return a quaternion without its rotation about the vertical.

    That is the tilt in ``q = twist * tilt``; up stays the same in the sensor's frame.
    """
    length = math.sqrt(z * z + w * w)
    if length < 1e-12:  # upside down: the twist is undefined
        return x, y, z, w
    c, s = w / length, -z / length
    return c * x - s * y, c * y + s * x, 0.0, length
