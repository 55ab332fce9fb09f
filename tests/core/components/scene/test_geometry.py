"""Geometry of meshes that viewers draw."""

from __future__ import annotations

import numpy as np

from physx_core.components import grid_mesh


def test_mesh_of_a_grid():
    points, cells = grid_mesh(np.array([[0.0, 1, 2], [3, 4, 5]]), np.array([0.5, 2.0]))
    assert points[[0, 2, 3]].tolist() == [[0, 0, 0], [0, 4, 2], [0.5, 0, 3]]
    assert cells.tolist() == [[0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2]]
