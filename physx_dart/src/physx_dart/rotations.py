"""Rotations: quaternions x, y, z, w, matrices and rotation vectors."""

from __future__ import annotations

import math

import numpy as np

from physx_core.interfaces.backend import Vector


def quaternion_from_vector(rotation: Vector) -> Vector:
    """Return the quaternion, shape (4,), of a rotation vector (3,) in rad."""
    angle = math.sqrt(rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2)
    half = 0.5 * angle
    scale = math.sin(half) / angle if angle > 1e-8 else 0.5
    x, y, z = rotation
    return np.array([scale * x, scale * y, scale * z, math.cos(half)])


def vector_from_quaternion(quaternion: Vector) -> Vector:
    """Return the rotation vector, shape (3,), in rad, at most pi long, of a unit quaternion."""
    w = float(quaternion[3])
    xyz = quaternion[:3] if w >= 0 else -quaternion[:3]
    sine = math.sqrt(xyz[0] ** 2 + xyz[1] ** 2 + xyz[2] ** 2)
    scale = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 1e-8 else 2.0
    return scale * xyz


def matrix_from_quaternion(quaternion: Vector) -> Vector:
    """Return the matrix, shape (3, 3), of a unit quaternion."""
    x, y, z, w = (float(part) for part in quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def product(left: Vector, right: Vector) -> Vector:
    """Return the unit quaternion of the rotation `right` followed by `left`."""
    a, b, c, d = (float(part) for part in left)
    x, y, z, w = (float(part) for part in right)
    result = np.array(
        [
            d * x + a * w + b * z - c * y,
            d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w,
            d * w - a * x - b * y - c * z,
        ]
    )
    return result / math.sqrt(result.dot(result))


def poses_from_matrices(transforms: Vector) -> Vector:
    """Return rows x, y, z and quaternion, shape (n, 7), of transforms, shape (n, 4, 4)."""
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
    poses[:, 3:] = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return poses
