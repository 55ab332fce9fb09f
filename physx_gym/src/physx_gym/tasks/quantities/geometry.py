"""Rotations and planar poses for quantities; quaternions are x, y, z, w."""

from __future__ import annotations

import math

import numpy as np

from physx_core.simulation.sensors.attitudes import product, turned_back
from physx_core.typing import Vector

_INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])


def roll_pitch_yaw(quaternions: Vector) -> Vector:
    """Return roll, pitch and yaw in rad, shape (..., 3), of quaternions (..., 4).

    The rotation is about the x axis first, then about the fixed y, then about the fixed z axis.
    """
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.stack([roll, pitch, yaw], axis=-1)


def yaw_of(quaternion: Vector) -> float:
    """Return the yaw in rad of a quaternion, shape (4,)."""
    x, y, z, w = quaternion.tolist()
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def matrices(quaternions: Vector) -> Vector:
    """Return rotation matrices, shape (..., 3, 3), of quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def rotation_vectors(quaternions: Vector) -> Vector:
    """Return rotation vectors in rad, shape (..., 3), of quaternions (..., 4), the short way."""
    signed = np.where(quaternions[..., 3:] < 0, -quaternions, quaternions)
    axis, length = signed[..., :3], np.linalg.norm(signed[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(length, signed[..., 3:])
    return axis * np.where(length > 1e-12, angle / np.maximum(length, 1e-12), 2.0)


def relative_poses(poses: Vector, frame: Vector) -> Vector:
    """Return poses, shape (n, 7), as seen from another one, shape (7,)."""
    turn = np.broadcast_to(frame[3:], (len(poses), 4))
    positions = turned_back(turn, poses[:, :3] - frame[:3])
    return np.concatenate([positions, product(turn * _INVERSE, poses[:, 3:])], axis=1)


def mean_quaternion(quaternions: Vector) -> Vector:
    """Return the mean rotation, shape (4,), of quaternions (n, 4).

    That is the eigenvector of the largest eigenvalue of the sum of their outer products (Markley
    et al., "Averaging Quaternions", 2007).
    """
    _, vectors = np.linalg.eigh(quaternions.T @ quaternions)
    mean: Vector = vectors[:, -1]
    return -mean if mean @ quaternions[0] < 0 else mean


def orientation_difference(later: Vector, earlier: Vector) -> Vector:
    """Return the rotations from some quaternions to others as vectors along the world's axes."""
    return rotation_vectors(product(later, earlier * _INVERSE))


def pose_difference(later: Vector, earlier: Vector) -> Vector:
    """Return motions between poses (..., 7): translation in m, then rotation vector in rad."""
    turn = orientation_difference(later[..., 3:], earlier[..., 3:])
    return np.concatenate([later[..., :3] - earlier[..., :3], turn], axis=-1)


def angle_difference(later: Vector, earlier: Vector) -> Vector:
    """Return differences of angles in rad, the short way, within [-pi, pi)."""
    difference: Vector = (np.asarray(later) - earlier + np.pi) % (2 * np.pi) - np.pi
    return difference


def odometry_difference(later: Vector, earlier: Vector) -> Vector:
    """Return the planar motion between (x, y, yaw), in the frame half way between them."""
    turn = float(angle_difference(later[2], earlier[2]))
    heading = float(earlier[2]) + 0.5 * turn
    x, y = (later[:2] - earlier[:2]).tolist()
    c, s = math.cos(heading), math.sin(heading)
    return np.array([c * x + s * y, c * y - s * x, turn])
