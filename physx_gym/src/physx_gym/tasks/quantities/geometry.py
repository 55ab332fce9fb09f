"""Relative poses and differences of poses for quantities; quaternions are x, y, z, w."""

from __future__ import annotations

import math

import numpy as np

from physx_core.rotations import (
    invert_rows,
    multiply_rows,
    rotate_back_rows,
    to_rotation_vector_rows,
)
from physx_core.typing import Vector


def relative_poses(poses: Vector, frame: Vector) -> Vector:
    """Return poses, shape (n, 7), as seen from another one, shape (7,)."""
    turn = np.broadcast_to(frame[3:], (len(poses), 4))
    positions = rotate_back_rows(turn, poses[:, :3] - frame[:3])
    return np.concatenate([positions, multiply_rows(invert_rows(turn), poses[:, 3:])], axis=1)


def orientation_difference(later: Vector, earlier: Vector) -> Vector:
    """Return the rotations from some quaternions to others as vectors along the world's axes."""
    return to_rotation_vector_rows(multiply_rows(later, invert_rows(earlier)))


def pose_difference(later: Vector, earlier: Vector) -> Vector:
    """Return motions between poses (..., 7): translation in m, then rotation vector in rad."""
    turn = orientation_difference(later[..., 3:], earlier[..., 3:])
    return np.concatenate([later[..., :3] - earlier[..., :3], turn], axis=-1)


def angle_difference(later: Vector, earlier: Vector) -> Vector:
    """Return differences of angles in rad, along the shorter arc, within [-pi, pi)."""
    difference: Vector = (np.asarray(later) - earlier + np.pi) % (2 * np.pi) - np.pi
    return difference


def odometry_difference(later: Vector, earlier: Vector) -> Vector:
    """Return the planar motion between (x, y, yaw), in the frame halfway between them."""
    turn = float(angle_difference(later[2], earlier[2]))
    heading = float(earlier[2]) + 0.5 * turn
    x, y = (later[:2] - earlier[:2]).tolist()
    c, s = math.cos(heading), math.sin(heading)
    return np.array([c * x + s * y, c * y - s * x, turn])
