"""Placing robots and objects on the ground."""

from __future__ import annotations

import numpy as np

from physx_core.typing import Vector
from physx_sim import Ground, HeightField, Simulation, Stairs


def offset_to_ground(
    simulation: Simulation, ground: Ground | Stairs | HeightField, name: str, positions: Vector
) -> Vector:
    """Return the translation, shape (3,) in m, that puts a robot or object on the ground.

    On a plane, it is along the normal; on stairs and height fields, it is vertical, to the highest
    point within the horizontal extent of the robot or object.

    Args:
        simulation: Simulation of a world with this ground.
        ground: The ground.
        name: Name of the robot or object.
        positions: Of the whole world, shape (nq,).
    """
    if isinstance(ground, Ground):
        normal = np.array(ground.normal)
        lowest = -simulation.reach(name, -normal, positions)
        gap = ground.height - lowest
        return gap * normal if np.isfinite(gap) else np.zeros(3)
    x, y = np.eye(3)[:2]
    sides = [simulation.reach(name, each, positions) for each in (-x, x, -y, y)]
    lowest = -simulation.reach(name, np.array([0.0, 0.0, -1.0]), positions)
    if not np.isfinite([*sides, lowest]).all():
        return np.zeros(3)
    left, right, front, back = sides
    return np.array([0.0, 0.0, _max_height(ground, (-left, right), (-front, back)) - lowest])


def _max_height(
    ground: Stairs | HeightField, x: tuple[float, float], y: tuple[float, float]
) -> float:
    """Return the maximum height, in m, of a ground within ranges of x and y."""
    if isinstance(ground, Stairs):
        tops = [
            center[2] + 0.5 * size[2]
            for center, size in ground.boxes()
            if _overlaps(x, center[0], size[0]) and _overlaps(y, center[1], size[1])
        ]
        return max(tops, default=0.0)
    part = ground.heights
    for axis, (low, high) in enumerate((x, y)):
        corner, spacing = ground.corner()[axis], ground.spacing[axis]
        last = part.shape[axis] - 1
        begin = int(np.clip(np.floor((low - corner) / spacing), 0, last))
        end = int(np.clip(np.ceil((high - corner) / spacing), 0, last))
        part = np.take(part, np.arange(begin, end + 1), axis)
    return float(part.max())


def _overlaps(ends: tuple[float, float], center: float, size: float) -> bool:
    return ends[0] <= center + 0.5 * size and ends[1] >= center - 0.5 * size
