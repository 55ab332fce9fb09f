"""Surfaces of static things: distances of points, with tangents and outward normals."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from physx_core.errors import FeatureNotSupportedError
from physx_core.rotations import to_matrix
from physx_core.simulation import Ground, HeightField, Stairs
from physx_core.typing import Vector
from physx_dart.models.parts import Static
from physx_dart.models.shapes import CollisionShape


class Surface(ABC):
    """A surface."""

    @abstractmethod
    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return distances of points (n, 3), negative inside, and the axes of the surface there.

        Returns:
            Distances in m, shape (n,); two tangents and the outward normal as rows, (n, 3, 3).
        """


@dataclass(frozen=True, eq=False)
class Plane(Surface):
    """An infinite plane: normal of length 1, and height along it in m."""

    normal: Vector
    height: float

    @cached_property
    def axes(self) -> Vector:
        """Two tangents and the normal, as rows."""
        return axes_of(self.normal[None])[0]

    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return distances and axes."""
        axes = np.broadcast_to(self.axes, (len(points), 3, 3))
        return points @ self.normal - self.height, axes


@dataclass(frozen=True, eq=False)
class Solid(Surface):
    """A shape at a place: center (3,), rotation matrix (3, 3)."""

    shape: CollisionShape
    center: Vector
    rotation: Vector

    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return distances and axes."""
        local = (points - self.center) @ self.rotation
        size = self.shape.size
        if self.shape.kind == "box":
            found, normals = _box(local, 0.5 * np.array(size))
        elif self.shape.kind == "cylinder":
            found, normals = _cylinder(local, *size)
        else:
            half = 0.5 * size[1] if self.shape.kind == "capsule" else 0.0
            axis = np.zeros_like(local)
            axis[:, 2] = np.clip(local[:, 2], -half, half)
            lengths, normals = _directions(local - axis)
            found = lengths - size[0]
        return found, axes_of(normals @ self.rotation.T)


@dataclass(frozen=True, eq=False)
class Heights(Surface):
    """A height field; distances are to the plane of the triangle below or above."""

    field: HeightField

    def distances(self, points: Vector) -> tuple[Vector, Vector]:
        """Return distances and axes."""
        heights, spacing = self.field.heights, np.array(self.field.spacing)
        grid = (points[:, :2] - self.field.corner()) / spacing
        last = np.array(heights.shape) - 1
        outside = ((grid < 0) | (grid > last)).any(axis=1)
        # A state that is not finite has distances that are not either, and is reported by the step.
        cell = np.clip(np.floor(np.nan_to_num(grid)), 0, last - 1).astype(np.intp)
        x, y = (grid - cell).T
        i, j = cell.T
        low, high = heights[i, j], heights[i + 1, j + 1]
        along_x, along_y = heights[i + 1, j], heights[i, j + 1]
        below = x >= y  # the triangle on the side of larger x
        slope_x = np.where(below, along_x - low, high - along_y)
        slope_y = np.where(below, high - along_x, along_y - low)
        height = low + slope_x * x + slope_y * y
        ones = np.ones(len(points))
        upward = np.column_stack([-slope_x / spacing[0], -slope_y / spacing[1], ones])
        lengths = np.linalg.norm(upward, axis=1)
        found = (points[:, 2] - height) / lengths
        found[outside] = np.inf
        return found, axes_of(upward / lengths[:, None])


def surfaces_of(static: Static, engine: str, features: Sequence[str]) -> list[Surface]:
    """Return the surfaces of something static."""
    what = static.what
    if isinstance(what, HeightField):
        return [Heights(what)]
    if isinstance(what, Ground):
        return [Plane(np.array(what.normal), float(what.height))]
    if isinstance(what, Stairs):
        found: list[Surface] = [Plane(np.array([0.0, 0.0, 1.0]), 0.0)]
        for center, size in what.boxes():
            box = CollisionShape("box", size, np.zeros(3), np.eye(3), "ground", 1.0, 0.0)
            found.append(Solid(box, np.array(center), np.eye(3)))
        return found
    if what.kind == "mesh":
        raise FeatureNotSupportedError(engine, "mesh_contacts", features, "Use a box instead.")
    rotation = to_matrix(static.orientation)
    return [Solid(what, np.array(static.position), rotation)]


def axes_of(normals: Vector) -> Vector:
    """Return two tangents and the normal itself for each normal (n, 3), as rows (n, 3, 3)."""
    x, y, z = normals.T
    steep, nothing = np.abs(z) > 0.5, np.zeros(len(x))
    first = np.where(steep, [z, nothing, -x], [y, -x, nothing]).T
    first /= np.sqrt(np.einsum("ij,ij->i", first, first))[:, None]
    return np.stack([first, np.cross(normals, first), normals], axis=1)


def _directions(vectors: Vector) -> tuple[Vector, Vector]:
    """Return lengths and directions of vectors; the direction of a zero vector is upward."""
    lengths = np.linalg.norm(vectors, axis=1)
    upward = np.array([0.0, 0.0, 1.0])
    safe = np.where(lengths > 1e-12, lengths, 1.0)[:, None]
    return lengths, np.where(lengths[:, None] > 1e-12, vectors / safe, upward)


def _box(local: Vector, half: Vector) -> tuple[Vector, Vector]:
    beyond = np.abs(local) - half
    lengths, outward = _directions(local - np.clip(local, -half, half))
    nearest = np.argmax(beyond, axis=1)
    rows = np.arange(len(local))
    inward = np.zeros_like(local)
    inward[rows, nearest] = np.where(local[rows, nearest] < 0, -1.0, 1.0)
    inside = beyond[rows, nearest] <= 0
    found = np.where(inside, beyond[rows, nearest], lengths)
    return found, np.where(inside[:, None], inward, outward)


def _cylinder(local: Vector, radius: float, length: float) -> tuple[Vector, Vector]:
    flat = local.copy()
    flat[:, 2] = 0.0
    radial, outward = _directions(flat)
    profile = np.column_stack([radial, np.zeros(len(local)), local[:, 2]])
    found, normals = _box(profile, np.array([radius, 1.0, 0.5 * length]))
    along = np.array([0.0, 0.0, 1.0])
    outward = np.where(radial[:, None] > 1e-12, outward, np.array([1.0, 0.0, 0.0]))
    return found, normals[:, :1] * outward + normals[:, 2:] * along
