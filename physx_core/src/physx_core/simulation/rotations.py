"""Rotations of single vectors: for a few of them much quicker than arrays.

A quaternion is x, y, z, w, of length 1.
"""

from __future__ import annotations

from collections.abc import Sequence

Triple = tuple[float, float, float]


def cross(a: float, b: float, c: float, x: float, y: float, z: float) -> Triple:
    """Return the cross product of (a, b, c) and (x, y, z)."""
    return b * z - c * y, c * x - a * z, a * y - b * x


def turned(quaternion: Sequence[float], a: float, b: float, c: float) -> Triple:
    """Return a vector turned by a quaternion."""
    x, y, z, w = quaternion
    s, t, u = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return a + w * s + (y * u - z * t), b + w * t + (z * s - x * u), c + w * u + (x * t - y * s)


def turned_back(quaternion: Sequence[float], a: float, b: float, c: float) -> Triple:
    """Return a vector of the outer frame along the axes that a quaternion turns it to."""
    x, y, z, w = quaternion
    s, t, u = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return a + w * s + (t * z - u * y), b + w * t + (u * x - s * z), c + w * u + (s * y - t * x)


def product(first: Sequence[float], second: Sequence[float]) -> tuple[float, ...]:
    """Return the rotation that turns by `second`, then by `first`."""
    a, b, c, d = first
    x, y, z, w = second
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )
