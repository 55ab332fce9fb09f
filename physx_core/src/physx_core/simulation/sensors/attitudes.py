"""Rotations of many sensors at once; quaternions x, y, z, w of shape (n, 4), vectors (n, 3)."""

from __future__ import annotations

import numpy as np

from physx_core.typing import Vector

_INVERSE = np.array([-1.0, -1.0, -1.0, 1.0])
_NEXT = np.array([1, 2, 0])


def cross(first: Vector, second: Vector) -> Vector:
    """Return the cross products of vectors; for a few of them much quicker than NumPy's."""
    products = first * second.take(_NEXT, -1) - first.take(_NEXT, -1) * second
    return products.take(_NEXT, -1)


def turned(q: Vector, vectors: Vector) -> Vector:
    """Return vectors turned by quaternions."""
    axis, w = q[..., :3], q[..., 3:]
    across = 2 * cross(axis, vectors)
    return vectors + w * across + cross(axis, across)


def turned_back(q: Vector, vectors: Vector) -> Vector:
    """Return vectors turned by the inverse of quaternions."""
    return turned(q * _INVERSE, vectors)


def product(first: Vector, second: Vector) -> Vector:
    """Return the rotations that turn by `second`, then by `first`."""
    a, b = first[..., :3], second[..., :3]
    v, w = first[..., 3:], second[..., 3:]
    scalar = v * w - np.sum(a * b, axis=-1, keepdims=True)
    return np.concatenate([v * b + w * a + cross(a, b), scalar], axis=-1)


def from_rotation_vectors(vectors: Vector) -> Vector:
    """Return the quaternions of rotation vectors, in rad."""
    half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([0.5 * vectors * np.sinc(half / np.pi), np.cos(half)], axis=-1)


def between(first: Vector, second: Vector, share: Vector) -> Vector:
    """Return the rotations at a share, shape (n, 1), of the way from `first` to `second`."""
    near = np.where(np.sum(first * second, axis=-1, keepdims=True) < 0, -second, second)
    mixed = first + share * (near - first)
    scaled: Vector = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
    return scaled
