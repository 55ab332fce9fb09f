"""Geometry of meshes."""

from __future__ import annotations

import numpy as np

from physx_core.typing import Array


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
