"""Rotations: quaternions x, y, z, w, matrices and rotation vectors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from physx_core.simulation.rotations import cross, turned_back
from physx_core.typing import Vector


def quaternion_of(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w, with w not negative, of a rotation vector in rad."""
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    scale, w = math.sin(half) / angle if angle > 1e-8 else 0.5, math.cos(half)
    if w < 0:
        scale, w = -scale, -w
    return scale * x, scale * y, scale * z, w


def base_accelerations(
    attitude: Sequence[float], linear: Sequence[float], twist: Vector
) -> tuple[float, float, float]:
    """Return the change of the linear part of a base's twist, along its own axes.

    Args:
        attitude: Quaternion x, y, z, w of the base.
        linear: Acceleration of its origin along the world's axes.
        twist: Its velocities: linear, angular, along its own axes; more may follow.
    """
    u, v, w, p, q, r = twist[:6].tolist()
    a, b, c = turned_back(attitude, *linear)
    x, y, z = cross(p, q, r, u, v, w)
    return a - x, b - y, c - z


def vector_from_quaternion(quaternion: Vector) -> Vector:
    """Return the rotation vector, shape (3,), in rad, at most pi long, of a unit quaternion."""
    w = float(quaternion[3])
    xyz = quaternion[:3] if w >= 0 else -quaternion[:3]
    sine = math.sqrt(xyz[0] ** 2 + xyz[1] ** 2 + xyz[2] ** 2)
    scale = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 1e-8 else 2.0
    return scale * xyz


def matrix_from_quaternion(quaternion: Vector | Sequence[float]) -> Vector:
    """Return the matrix, shape (3, 3), of a unit quaternion."""
    x, y, z, w = map(float, quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def poses_from_matrices(transforms: Vector) -> Vector:
    """Return rows x, y, z and quaternion (w not negative), (n, 7), of transforms (n, 4, 4)."""
    poses = np.empty((len(transforms), 7))
    poses[:, :3] = transforms[:, :3, 3]
    # Each row is the quaternion times 4 times one of its parts; the largest is divided by.
    m = transforms[:, :3, :3]
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    xw, yw, zw = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    rows = np.array(
        [
            [1 + xx - yy - zz, xy, xz, xw],
            [xy, 1 - xx + yy - zz, yz, yw],
            [xz, yz, 1 - xx - yy + zz, zw],
            [xw, yw, zw, 1 + xx + yy + zz],
        ]
    )
    largest = np.argmax(np.einsum("iin->in", rows), axis=0)
    quaternions = rows[largest, :, np.arange(len(m))]
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    poses[:, 3:] = quaternions / np.where(quaternions[:, 3:] < 0, -lengths, lengths)
    return poses
