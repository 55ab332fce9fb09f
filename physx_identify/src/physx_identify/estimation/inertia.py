"""Inertia of bodies as ten numbers, linear in torques; and which ten numbers a body can have.

The order is that of Pinocchio: mass (kg), first moments x, y, z (kg m), second moments xx, xy, yy,
xz, yz, zz about the frame's origin (kg m²).
"""

from __future__ import annotations

import numpy as np

from physx_core.typing import Vector

TEN = ("mass", "moment x", "moment y", "moment z", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Names of the ten numbers."""
UNITS = ("kg", *3 * ("kg m",), *6 * ("kg m²",))
"""Their units."""
_ROWS, _COLUMNS = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])


def ten_of(mass: float, center: Vector, inertia: Vector) -> Vector:
    """Return the ten numbers, shape (10,).

    Args:
        mass: In kg.
        center: Center of mass, shape (3,), in m.
        inertia: Moments of inertia about it, shape (3, 3), in kg m².
    """
    about = inertia + mass * (center @ center * np.eye(3) - np.outer(center, center))
    return np.concatenate([[mass], mass * center, about[_ROWS, _COLUMNS]])


def body_of(ten: Vector) -> tuple[float, Vector, Vector]:
    """Return mass, center and moments about it, as `ten_of` takes them."""
    mass, center = float(ten[0]), ten[1:4] / ten[0]
    about = np.zeros((3, 3))
    about[_ROWS, _COLUMNS] = about[_COLUMNS, _ROWS] = ten[4:]
    return mass, center, about - mass * (center @ center * np.eye(3) - np.outer(center, center))


def pseudo(ten: Vector) -> Vector:
    """Return the matrix of second moments of mass, shape (4, 4): positive definite for a body."""
    about, found = np.zeros((3, 3)), np.empty((4, 4))
    about[_ROWS, _COLUMNS] = about[_COLUMNS, _ROWS] = ten[4:]
    found[:3, :3] = 0.5 * np.trace(about) * np.eye(3) - about
    found[:3, 3] = found[3, :3] = ten[1:4]
    found[3, 3] = ten[0]
    return found


def from_pseudo(matrix: Vector) -> Vector:
    """Return the ten numbers of `pseudo`."""
    second = matrix[:3, :3]
    about = np.trace(second) * np.eye(3) - second
    return np.concatenate([[matrix[3, 3]], matrix[:3, 3], about[_ROWS, _COLUMNS]])


def carried(pose: Vector) -> Vector:
    """Return the matrix (10, 10) that moves ten numbers from a frame to the one it is placed in.

    Args:
        pose: Of the frame in the other, a homogeneous matrix of shape (4, 4).
    """
    return np.stack([from_pseudo(pose @ pseudo(unit) @ pose.T) for unit in np.eye(10)], axis=1)


def cholesky_of(ten: Vector) -> Vector:
    """Return the log-Cholesky coordinates of a body, shape (10,): any numbers are a body."""
    factor = np.linalg.cholesky(pseudo(ten))
    found: Vector = np.concatenate([np.log(np.diag(factor)), factor[np.tril_indices(4, -1)]])
    return found


def from_cholesky(coordinates: Vector) -> Vector:
    """Return the ten numbers of log-Cholesky coordinates."""
    factor = np.diag(np.exp(coordinates[:4]))
    factor[np.tril_indices(4, -1)] = coordinates[4:]
    return from_pseudo(factor @ factor.T)


def is_physical(ten: Vector) -> bool:
    """Return whether a body can have these ten numbers."""
    return bool(np.linalg.eigvalsh(pseudo(ten)).min() > 0)
