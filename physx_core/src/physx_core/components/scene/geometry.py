"""Geometry of meshes."""

from __future__ import annotations

import numpy as np

from physx_core.typing import Array


def grid_mesh(heights: Array, spacing: Array) -> tuple[Array, Array]:
    """Return the vertices and triangles of a height field, shapes (n, 3) and (m, 3).

    Args:
        heights: z of each point of the grid, shape (nx, ny), in m.
        spacing: Distances of the points in x and y, in m.
    """
    x, y = (gap * np.arange(count) for gap, count in zip(spacing, heights.shape, strict=True))
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), heights], axis=-1)
    nx, ny = heights.shape
    first = (np.arange(nx - 1)[:, None] * ny + np.arange(ny - 1)).ravel()
    corners = [first, first + ny, first + ny + 1, first, first + ny + 1, first + 1]
    cells = np.stack(corners, axis=1).reshape(-1, 3)
    return points.reshape(-1, 3).astype(np.float32), cells.astype(np.int32)


def vertex_normals(positions: Array, cells: Array) -> Array:
    """Return the unit normals of a mesh's vertices, shape (n, 3): area-weighted means.

    Args:
        positions: Vertices, shape (n, 3).
        cells: Indices of the vertices of each triangle, shape (m, 3).
    """
    normals = np.zeros_like(positions)
    if not len(positions) or not len(cells):
        return normals
    corners = positions[cells]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for axis in range(3):
        weights = np.repeat(faces[:, axis], 3)
        normals[:, axis] = np.bincount(cells.ravel(), weights, minlength=len(positions))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    units: Array = normals / np.maximum(lengths, 1e-12)
    return units
