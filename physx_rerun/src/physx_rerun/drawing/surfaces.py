"""Surfaces, symbols and color bars as triangles and lines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from physx_core.components import grid_mesh
from physx_core.typing import Array
from physx_rerun.drawing.framing import extremes

_ANGLES = np.linspace(0, 2 * np.pi, 25)


def _around(*angles: float, radii: tuple[float, ...] = (1.0,)) -> Array:
    turns = np.deg2rad(angles)
    return np.stack([np.cos(turns), np.sin(turns)], axis=1) * np.resize(radii, len(turns))[:, None]


SYMBOLS: Mapping[str, tuple[Array, ...]] = {
    "circle": (np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1),),
    "cross": (_around(45, 225), _around(135, 315)),
    "diamond": (_around(0, 90, 180, 270, 360),),
    "plus": (_around(0, 180), _around(90, 270)),
    "square": (_around(45, 135, 225, 315, 405),),
    "star": (_around(*range(90, 451, 36), radii=(1.0, 0.4)),),
    "triangle": (_around(90, 210, 330, 450),),
}
"""Lines of the symbols: corners in the plane, at most 1 from the center."""


def symbol_lines(symbol: str, positions: Array, normals: Array | None, size: float) -> list[Array]:
    """Return the corners of symbols, one array per line, symbol by symbol.

    Args:
        symbol: Name of the symbol.
        positions: Centers, shape (n, 3).
        normals: Directions that the symbols face, shape (n, 3); None: upward.
        size: Radius in m.
    """
    is_given = normals is not None and len(normals) > 0
    facing = np.array(normals) if is_given else np.zeros_like(positions)
    facing[~facing.any(axis=1), 2] = 1.0
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    helper = np.where(np.abs(facing[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    up = np.cross(facing, helper)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    across = np.cross(up, facing)
    lines = [
        positions[:, None] + size * (part[:, :1] * across[:, None] + part[:, 1:] * up[:, None])
        for part in SYMBOLS[symbol]
    ]
    return [line[row].astype(np.float32) for row in range(len(positions)) for line in lines]


def mesh_of(kind: str, values: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return the vertices (n, 3) and triangles (m, 3) of a mesh, a height field or a slice."""
    if kind == "mesh":
        return values["positions"], values["cells"]
    # Rerun's `GridMap` is flat, with square cells of one color each instead of values at points.
    is_field = kind == "height_field"
    heights = values["heights"] if is_field else np.zeros(values["values"].shape, np.float32)
    return grid_mesh(heights, values["spacing"])


GRIDS = ("height_field", "slice", "volume")
"""Kinds of grids."""


def corners_of_grid(kind: str, values: Mapping[str, Any]) -> Array:
    """Return opposite corners of a grid in its own frame, shape (2, 3)."""
    grid = values["heights"] if kind == "height_field" else values["values"]
    cells = np.array(grid.shape) - (0 if kind == "volume" else 1)
    extent = cells * values["spacing"]
    if kind == "volume":
        return np.stack([0 * extent, extent])
    low, high = (grid.min(), grid.max()) if kind == "height_field" else (0.0, 0.0)
    return np.array([[0.0, 0.0, low], [*extent, high]])


def edges_of(cells: Array) -> Array:
    """Return the pairs of vertices joined by edges, shape (edges, 2)."""
    pairs = np.sort(cells[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0)


def bar_beside(points: Array, right: Array, parts: int) -> tuple[Array, Array, Array]:
    """Return an upright bar next to points.

    Args:
        points: The points, shape (n, 3).
        right: Horizontal direction in which to place it, shape (3,).
        parts: Number of parts along its height.

    Returns:
        Vertices (2 (parts + 1), 3), triangles (m, 3), and a point next to each of three heights.
    """
    low, high = extremes(points)
    size = max(float(np.linalg.norm(high - low)), 1e-3)
    foot = 0.5 * (low + high) + 0.6 * size * right - [0.0, 0.0, 0.35 * size]
    levels = foot + np.linspace(0.0, 0.7 * size, parts + 1)[:, None] * [0.0, 0.0, 1.0]
    corners = np.concatenate([levels, levels + 0.05 * size * right])
    here, there = np.arange(parts), np.arange(parts) + parts + 1
    sides = [(here, there, there + 1), (here, there + 1, here + 1)]
    cells = np.concatenate([np.stack(side, axis=1) for side in sides])
    ticks = levels[[0, parts // 2, parts]] + 0.08 * size * right
    return corners.astype(np.float32), cells.astype(np.int32), ticks.astype(np.float32)
