"""Rotations: quaternions, rotation vectors, matrices, and roll, pitch, and yaw.

A quaternion is x, y, z, w, of length 1; angles are in rad. Most functions exist twice: for one
rotation as plain numbers, which for a few rotations is many times faster than arrays, and with the
suffix ``_rows`` for arrays whose last axis holds the quaternion or vector.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from physx_core.typing import Vector

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)
"""Quaternion of no rotation."""
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_NEXT = np.array([1, 2, 0])
_UNIT = np.eye(3).ravel()
_TO_MATRIX = np.zeros((16, 9))
"""Maps the products of all pairs of components to the matrix minus the unit matrix, by rows."""
_TO_MATRIX[[5, 10, 1, 11, 2, 7], [0, 0, 1, 1, 2, 2]] = -2.0, -2.0, 2.0, -2.0, 2.0, 2.0
_TO_MATRIX[[1, 11, 0, 10, 6, 3], [3, 3, 4, 4, 5, 5]] = 2.0, 2.0, -2.0, -2.0, 2.0, -2.0
_TO_MATRIX[[2, 7, 6, 3, 0, 5], [6, 6, 7, 7, 8, 8]] = 2.0, -2.0, 2.0, 2.0, -2.0, -2.0


# Products ---------------------------------------------------------------------------------------


def cross(a: float, b: float, c: float, x: float, y: float, z: float) -> Triple:
    """Return the cross product of (a, b, c) and (x, y, z)."""
    return b * z - c * y, c * x - a * z, a * y - b * x


def cross_rows(first: Vector, second: Vector) -> Vector:
    """Return the cross products of vectors (..., 3); much faster than NumPy's for a few vectors."""
    products = first * second.take(_NEXT, -1) - first.take(_NEXT, -1) * second
    return products.take(_NEXT, -1)


def multiply(first: Sequence[float], second: Sequence[float]) -> Quaternion:
    """Return the quaternion that rotates by `second`, then by `first`."""
    a, b, c, d = first
    x, y, z, w = second
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def multiply_rows(first: Vector, second: Vector) -> Vector:
    """Return the quaternions (..., 4) that rotate by `second`, then by `first`."""
    a, b = first[..., :3], second[..., :3]
    v, w = first[..., 3:], second[..., 3:]
    scalar = v * w - np.sum(a * b, axis=-1, keepdims=True)
    return np.concatenate([v * b + w * a + cross_rows(a, b), scalar], axis=-1)


def invert(quaternion: Sequence[float]) -> Quaternion:
    """Return the inverse rotation."""
    x, y, z, w = quaternion
    return -x, -y, -z, w


def invert_rows(quaternions: Vector) -> Vector:
    """Return the inverse rotations of quaternions (..., 4)."""
    found: Vector = quaternions * _CONJUGATE
    return found


def rotate(quaternion: Sequence[float], a: float, b: float, c: float) -> Triple:
    """Return the vector (a, b, c) rotated by a quaternion."""
    x, y, z, w = quaternion
    s, t, u = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return a + w * s + (y * u - z * t), b + w * t + (z * s - x * u), c + w * u + (x * t - y * s)


def rotate_rows(quaternions: Vector, vectors: Vector) -> Vector:
    """Return vectors (..., 3) rotated by quaternions (..., 4)."""
    axis, w = quaternions[..., :3], quaternions[..., 3:]
    across = 2 * cross_rows(axis, vectors)
    return vectors + w * across + cross_rows(axis, across)


def rotate_back(quaternion: Sequence[float], a: float, b: float, c: float) -> Triple:
    """Return the vector (a, b, c) rotated by the inverse of a quaternion.

    This converts a vector from the world frame to the frame of a body with this orientation.
    """
    x, y, z, w = quaternion
    s, t, u = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return a + w * s + (t * z - u * y), b + w * t + (u * x - s * z), c + w * u + (s * y - t * x)


def rotate_back_rows(quaternions: Vector, vectors: Vector) -> Vector:
    """Return vectors (..., 3) rotated by the inverses of quaternions (..., 4)."""
    return rotate_rows(quaternions * _CONJUGATE, vectors)


# Axes, angles, and rotation vectors -------------------------------------------------------------


def from_axis_angle(axis: Sequence[float], angle: float) -> Quaternion:
    """Return the quaternion of a rotation about an axis of length 1."""
    s = math.sin(0.5 * angle)
    return s * axis[0], s * axis[1], s * axis[2], math.cos(0.5 * angle)


def from_rotation_vector(x: float, y: float, z: float) -> Quaternion:
    """Return the quaternion of a rotation vector; w is not negative."""
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    scale, w = math.sin(half) / angle if angle > 1e-8 else 0.5, math.cos(half)
    if w < 0:
        scale, w = -scale, -w
    return scale * x, scale * y, scale * z, w


def from_rotation_vector_rows(vectors: Vector) -> Vector:
    """Return the quaternions (..., 4) of rotation vectors (..., 3); w may be negative."""
    half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([0.5 * vectors * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def to_rotation_vector(quaternion: Vector) -> Vector:
    """Return the rotation vector of a quaternion, shape (3,), at most pi long."""
    w = float(quaternion[3])
    xyz = quaternion[:3] if w >= 0 else -quaternion[:3]
    sine = math.sqrt(xyz[0] ** 2 + xyz[1] ** 2 + xyz[2] ** 2)
    scale = 2.0 * math.atan2(sine, abs(w)) / sine if sine > 1e-8 else 2.0
    return scale * xyz


def to_rotation_vector_rows(quaternions: Vector) -> Vector:
    """Return the rotation vectors of quaternions (..., 4), shape (..., 3), at most pi long."""
    signed = np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)
    axis, length = signed[..., :3], np.linalg.norm(signed[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(length, signed[..., 3:])
    return axis * np.where(length > 1e-12, angle / np.maximum(length, 1e-12), 2.0)


# Roll, pitch, and yaw: about the x axis, then about the fixed y, then about the fixed z axis ------


def from_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion of roll, pitch, and yaw."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    x, y = sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return x, y, z, w


def to_roll_pitch_yaw(quaternion: Sequence[float]) -> Triple:
    """Return the roll, pitch, and yaw of a quaternion."""
    x, y, z, w = quaternion
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def to_roll_pitch_yaw_rows(quaternions: Vector) -> Vector:
    """Return the roll, pitch, and yaw of quaternions (..., 4), shape (..., 3)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)


# Matrices ---------------------------------------------------------------------------------------


def to_matrix(quaternion: Vector | Sequence[float]) -> Vector:
    """Return the rotation matrix of a quaternion, shape (3, 3)."""
    x, y, z, w = map(float, quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def to_matrix_rows(quaternions: Vector) -> Vector:
    """Return the rotation matrices of quaternions (..., 4), shape (..., 3, 3)."""
    products = quaternions[..., :, None] * quaternions[..., None, :]
    found: Vector = products.reshape(*quaternions.shape[:-1], 16) @ _TO_MATRIX
    return (found + _UNIT).reshape(*quaternions.shape[:-1], 3, 3)


def from_matrix_rows(matrices: Vector) -> Vector:
    """Return the quaternions (n, 4) of rotation matrices (n, 3, 3); w is not negative."""
    # Each row is the quaternion times 4 times one of its components; use the largest one.
    m = matrices
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
    found: Vector = quaternions / np.where(quaternions[:, 3:] < 0, -lengths, lengths)
    return found


# Several rotations ------------------------------------------------------------------------------


def interpolate_rows(first: Vector, second: Vector, share: Vector) -> Vector:
    """Return the rotations at a fraction `share`, shape (n, 1), of the way from first to second."""
    near = np.where(np.sum(first * second, axis=-1, keepdims=True) < 0, -second, second)
    mixed = first + share * (near - first)
    scaled: Vector = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return scaled


def mean(quaternions: Vector) -> Vector:
    """Return the mean rotation of quaternions (n, 4), shape (4,).

    It is the eigenvector of the largest eigenvalue of the sum of their outer products (Markley et
    al., "Averaging Quaternions", 2007).
    """
    _, vectors = np.linalg.eigh(quaternions.T @ quaternions)
    found: Vector = vectors[:, -1]
    return -found if found @ quaternions[0] < 0 else found
