"""Extent of the collision shapes of a robot or object along a direction."""

from __future__ import annotations

import math

import numpy as np

from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim.engines.models.meshes import read_vertices
from physx_sim.engines.models.parts import MovableBody
from physx_sim.engines.models.shapes import CollisionShape


class Reach:
    """Collision shapes of a robot or object, prepared for extent queries."""

    def __init__(self, movable: MovableBody) -> None:
        links = {name: i for i, name in enumerate(movable.model.links)}
        self._shapes = [(links.get(shape.body, 0), shape) for shape in movable.model.shapes]
        self._corners: list[Vector | None] = [_corners(shape) for _, shape in self._shapes]

    def along(self, direction: Vector, poses: Vector) -> float:
        """Return the largest dot product of a direction with a point of the shapes; -inf: none.

        Args:
            direction: Shape (3,).
            poses: Poses of the links, shape (links, 7).
        """
        found = [-math.inf]
        for (link, shape), corners in zip(self._shapes, self._corners, strict=True):
            pose = poses[link]
            along = direction @ to_matrix(pose[3:])
            middle = float(direction @ pose[:3] + along @ shape.position)
            local = along @ shape.rotation
            if corners is not None:
                found.append(middle + float((corners @ local).max()))
            else:
                found.append(middle + _round(shape, local))
        return max(found)


def _corners(shape: CollisionShape) -> Vector | None:
    """Return the corners of a box or mesh relative to its center, shape (n, 3)."""
    if shape.mesh is not None:
        return read_vertices(shape.mesh, shape.size)
    if shape.kind == "box":
        signs = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
        corners: Vector = signs * np.array(shape.size)
        return corners
    return None


def _round(shape: CollisionShape, along: Vector) -> float:
    """Return the extent of a round shape from its center along a local direction."""
    radius, length = shape.size[0], float(np.linalg.norm(along))
    if shape.kind == "sphere":
        return radius * length
    axial = abs(float(along[2]))
    across = length if shape.kind == "capsule" else math.hypot(float(along[0]), float(along[1]))
    return 0.5 * shape.size[1] * axial + radius * across
