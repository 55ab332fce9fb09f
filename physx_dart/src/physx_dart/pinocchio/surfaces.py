"""Surfaces of static bodies: distances of points, with tangents and outward normals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physx_core.rotations import cross_rows
from physx_core.typing import Vector
from physx_sim import Ground, HeightField, Stairs
from physx_sim.engines import Static

_EDGE = 1e-5
"""Distance from an edge, relative to a cell, up to which a point counts as at the edge."""
_CROSS = np.zeros((3, 9))
_CROSS[[0, 0, 1, 1, 2, 2], [7, 5, 2, 6, 3, 1]] = -1.0, 1.0, -1.0, 1.0, -1.0, 1.0
"""Maps a vector to its cross-product matrix, flattened by columns; multiplied by a row, it gives
the cross product of the vector and the row."""


class Surface(ABC):
    """A surface."""

    @abstractmethod
    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return the distances of points (n, 3), negative inside, and the surface axes there.

        Returns:
            Distances in m, shape (n,); two tangents and the outward normal as rows,
            shape (n, 3, 3).
        """

    def at_edges(self, points: Vector) -> NDArray[np.bool_]:
        """Return whether points (n, 3) are where the surface bends."""
        return np.zeros(len(points), np.bool_)

    def twist_rows(self, points: Vector, axes: Vector) -> Vector:
        """Return what maps a twist to the velocities of points (n, 3) along the axes there.

        Returns:
            The axes and the points' cross products with them, shape (n, 3, 6).
        """
        return twist_rows(points, axes)

    def normal_rows(self, points: Vector, axes: Vector) -> Vector:
        """Return the last of `twist_rows` for each point, shape (n, 6)."""
        return np.concatenate([axes[:, 2], cross_rows(points, axes[:, 2])], axis=1)


class Plane(Surface):
    """An infinite plane: unit normal, and height along it in m."""

    def __init__(self, normal: Vector, height: float) -> None:
        self.normal, self.height = normal, height
        axes = axes_of(normal[None])
        # Rows are a linear function of a point plus constants, which are kept once per point, as
        # adding arrays of different shapes takes four times as long.
        ends = twist_rows(np.concatenate([np.zeros((1, 3)), np.eye(3)]), axes).reshape(4, 18)
        self._slopes = ends[1:] - ends[0]
        self._normal_slopes = self._slopes[:, 12:].copy()
        self._keep_constants(axes, 1)

    def _keep_constants(self, axes: Vector, n: int) -> None:
        """Keep the axes and the rows of n points at the origin."""
        self._axes = axes[:1].repeat(n, 0)
        origins = twist_rows(np.zeros((n, 3)), self._axes)
        self._rows, self._normal_rows = origins.reshape(n, 18), origins[:, 2].copy()

    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return distances and axes."""
        if len(self._axes) < len(points):
            self._keep_constants(self._axes, len(points))
        return points.dot(self.normal) - self.height, self._axes[: len(points)]

    def twist_rows(self, points: Vector, axes: Vector) -> Vector:
        """Return the rows of points of which distances are known."""
        rows: Vector = points.dot(self._slopes)
        rows += self._rows[: len(points)]
        return rows.reshape(-1, 3, 6)

    def normal_rows(self, points: Vector, axes: Vector) -> Vector:
        """Return the last of them for each point."""
        rows: Vector = points.dot(self._normal_slopes)
        rows += self._normal_rows[: len(points)]
        return rows


@dataclass(frozen=True, eq=False)
class Heights(Surface):
    """A height field; distances are to the plane of the triangle below or above a point."""

    field: HeightField

    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return distances and axes."""
        heights, spacing = self.field.heights, np.array(self.field.spacing)
        grid = (points[:, :2] - self.field.corner()) / spacing
        last = np.array(heights.shape) - 1
        outside = ((grid < 0) | (grid > last)).any(axis=1)
        # A non-finite state has non-finite distances; the step reports it.
        cell = np.clip(np.floor(np.nan_to_num(grid)), 0, last - 1).astype(np.intp)
        x, y = (grid - cell).T
        i, j = cell.T
        low, high = heights[i, j], heights[i + 1, j + 1]
        along_x, along_y = heights[i + 1, j], heights[i, j + 1]
        below = x >= y  # the triangle on the larger-x side
        slope_x = np.where(below, along_x - low, high - along_y)
        slope_y = np.where(below, high - along_x, along_y - low)
        height = low + slope_x * x + slope_y * y
        ones = np.ones(len(points))
        upward = np.column_stack([-slope_x / spacing[0], -slope_y / spacing[1], ones])
        lengths = np.linalg.norm(upward, axis=1)
        found = (points[:, 2] - height) / lengths
        found[outside] = np.inf
        return found, axes_of(upward / lengths[:, None])

    def at_edges(self, points: Vector) -> NDArray[np.bool_]:
        """Return whether points are at an edge of a triangle."""
        grid = (points[:, :2] - self.field.corner()) / np.array(self.field.spacing)
        diagonal = grid[:, :1] - grid[:, 1:]
        lines = np.concatenate([grid, diagonal], axis=1)
        found: NDArray[np.bool_] = (np.abs(lines - np.round(lines)) < _EDGE).any(axis=1)
        return found


def surface_of(static: Static) -> Surface | None:
    """Return the surface of the ground; None for shapes, including the steps of stairs."""
    what = static.what
    if isinstance(what, HeightField):
        return Heights(what)
    if isinstance(what, Ground):
        return Plane(np.array(what.normal), float(what.height))
    return Plane(np.array([0.0, 0.0, 1.0]), 0.0) if isinstance(what, Stairs) else None


def axes_of(normals: Vector) -> Vector:
    """Return two tangents and the normal itself for each normal (n, 3), as rows (n, 3, 3)."""
    x, y, z = normals.T
    steep, nothing = np.abs(z) > 0.5, np.zeros(len(x))
    first = np.where(steep, [z, nothing, -x], [y, -x, nothing]).T
    first /= np.sqrt(np.einsum("ij,ij->i", first, first))[:, None]
    return np.stack([first, cross_rows(normals, first), normals], axis=1)


def twist_rows(points: Vector, axes: Vector) -> Vector:
    """Return what maps a twist to the velocities of points (n, 3) along axes (n or 1, 3, 3).

    Returns:
        The axes and the points' cross products with them, shape (n, 3, 6).
    """
    moments = axes @ (points @ _CROSS).reshape(-1, 3, 3)
    return np.concatenate([np.broadcast_to(axes, moments.shape), moments], axis=2)
