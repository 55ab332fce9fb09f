"""Geometry: values from one mesh or grid to another, voxels inside a mesh, and visible points.

A `LinearMap` is computed once and applied to any values: from the nodes of a coarse mesh to the
points of a fine one (`barycentric_map`), from a grid to points (`trilinear_map`). `voxelize` makes
a grid of a closed surface for networks that convolve, `visible` chooses what a camera sees.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from physx_core.errors import ConfigError
from physx_core.typing import Array, Index

_BLOCK = 2_000_000
"""Pairs of points and cells that are examined at once."""
_CLOSE = 1e-9
"""Share of a line of sight, or of a cell, that counts as nothing."""
_HIDING = 1e-6
"""Share of a line of sight before its end in which a triangle does not hide the end."""


class LinearMap(NamedTuple):
    """A map whose results are weighted sums of a few values each.

    Attributes:
        numbers: Numbers of the values, shape (n, k).
        weights: Their weights, of sum 1, shape (n, k).
        inside: Whether the point is in the mesh or grid, shape (n,).
    """

    numbers: Index
    weights: Array
    inside: Array

    def __call__(self, values: ArrayLike) -> Array:
        """Return the values of the points, shape (n, ...).

        Args:
            values: Those of the nodes, shape (nodes, ...).
        """
        chosen = np.asarray(values)[self.numbers]
        found: Array = np.einsum("nk,nk...->n...", self.weights, chosen)
        return found


class VoxelGrid(NamedTuple):
    """Cubes of a grid, some of which are inside a surface.

    Attributes:
        origin: Center of the first cube, shape (3,), in m.
        spacing: Length of an edge in m.
        inside: Whether the center of each cube is inside, shape (nx, ny, nz).
    """

    origin: Array
    spacing: float
    inside: Array

    @property
    def cubes(self) -> Index:
        """Place in the grid of each cube that is inside, shape (n, 3)."""
        return np.argwhere(self.inside)

    @property
    def cube_at(self) -> Index:
        """Number of each cube among those inside, -1 of all others, shape (nx, ny, nz)."""
        found = np.full(self.inside.shape, -1, np.intp)
        found[self.inside] = np.arange(np.count_nonzero(self.inside))
        return found

    @property
    def centers(self) -> Array:
        """Centers of the cubes that are inside, shape (n, 3), in m."""
        found: Array = self.origin + self.spacing * self.cubes
        return found

    def map_to(self, points: ArrayLike) -> LinearMap:
        """Return the map from values of the whole grid, flat, to points: see `trilinear_map`."""
        return trilinear_map(points, self.origin, self.spacing, self.inside.shape)


def barycentric_map(points: ArrayLike, nodes: ArrayLike, cells: ArrayLike) -> LinearMap:
    """Return the map from values of a mesh's nodes to points, linear in each cell.

    A point outside belongs to the cell that it is least outside of, which is continued linearly.

    Args:
        points: The points, shape (n, d) with d 2 or 3.
        nodes: The nodes, shape (nodes, d).
        cells: Triangles in the plane, tetrahedra in space: numbers of nodes, shape (cells, d + 1).

    Raises:
        ConfigError: If a shape is another one, or a cell has no volume.
    """
    points, nodes, cells = np.asarray(points, float), np.asarray(nodes, float), np.asarray(cells)
    size = nodes.shape[-1]
    _check("points", points, (None, size))
    _check("nodes", nodes, (None, 2 if size == 2 else 3))
    _check("cells", cells, (None, size + 1))
    if not len(cells):
        raise ConfigError("A mesh without cells maps no values.")
    corners = nodes[cells]
    edges = corners[:, 1:] - corners[:, :1]
    lengths = np.linalg.norm(edges, axis=2).max(axis=1)
    flat = np.abs(np.linalg.det(edges)) <= _CLOSE * lengths**size
    if flat.any():
        raise ConfigError(f"The cell {np.flatnonzero(flat)[0]} has no volume.")
    inverse = np.linalg.inv(edges)
    chosen, weights = np.empty(len(points), np.intp), np.empty((len(points), size + 1))
    for part in _blocks(len(points), len(cells)):
        others = np.einsum("ncd,cde->nce", points[part, None] - corners[:, 0], inverse)
        found = np.concatenate([1 - others.sum(axis=2, keepdims=True), others], axis=2)
        best = found.min(axis=2).argmax(axis=1)
        chosen[part], weights[part] = best, found[np.arange(len(best)), best]
    return LinearMap(cells[chosen], weights, weights.min(axis=1) >= -_CLOSE)


def trilinear_map(
    points: ArrayLike, origin: ArrayLike, spacing: ArrayLike, shape: tuple[int, ...]
) -> LinearMap:
    """Return the map from values of a grid, flat in C order, to points, linear along each axis.

    A point outside has the values of the nearest place in the grid.

    Args:
        points: The points, shape (n, d).
        origin: The first point of the grid, shape (d,).
        spacing: Distance between its points, along each axis or all of them.
        shape: Number of its points along each axis, d positive numbers.

    Raises:
        ConfigError: If a shape is another one, or a number is not positive.
    """
    points, last = np.asarray(points, float), np.array(shape) - 1
    size = len(shape)
    _check("points", points, (None, size))
    steps = np.broadcast_to(np.asarray(spacing, float), (size,))
    if not ((last >= 0).all() and (steps > 0).all()):
        raise ConfigError(f"A grid of shape {shape} and spacing {spacing!r} has no points.")
    places = (points - np.asarray(origin, float)) / steps
    inside = ((places >= -_CLOSE) & (places <= last + _CLOSE)).all(axis=1)
    places = np.clip(places, 0, last)
    first = np.minimum(places.astype(np.intp), np.maximum(last - 1, 0))
    rest = places - first
    index, weights = np.zeros((len(points), 1), np.intp), np.ones((len(points), 1))
    for axis in range(size):
        ends = np.stack([first[:, axis], np.minimum(first[:, axis] + 1, last[axis])], 1)
        shares = np.stack([1 - rest[:, axis], rest[:, axis]], 1)
        index = (index[:, :, None] * shape[axis] + ends[:, None]).reshape(len(points), -1)
        weights = (weights[:, :, None] * shares[:, None]).reshape(len(points), -1)
    return LinearMap(index, weights, inside)


def voxelize(nodes: ArrayLike, triangles: ArrayLike, spacing: float, margin: int = 0) -> VoxelGrid:
    """Return the cubes inside a closed surface: those around whose centers it winds.

    Args:
        nodes: Corners of the surface, shape (nodes, 3), in m.
        triangles: Numbers of nodes, all in the same sense of rotation, shape (triangles, 3).
        spacing: Length of a cube's edge in m.
        margin: Number of further layers of cubes around the surface.

    Raises:
        ConfigError: If a shape is another one, or a number is negative, or the spacing 0.
    """
    nodes, triangles = np.asarray(nodes, float), np.asarray(triangles)
    _check("nodes", nodes, (None, 3))
    _check("triangles", triangles, (None, 3))
    if not spacing > 0 or margin < 0:
        raise ConfigError(f"Cubes of {spacing} m with a margin of {margin} are no grid.")
    used = nodes[np.unique(triangles)]
    low, high = used.min(axis=0), used.max(axis=0)
    counts = np.maximum(1, np.ceil((high - low) / spacing - _CLOSE).astype(int)) + 2 * margin
    origin = (low + high) / 2 - (counts - 1) / 2 * spacing
    centers = origin + spacing * np.indices(counts).reshape(3, -1).T
    turns = np.empty(len(centers))
    for part in _blocks(len(centers), len(triangles)):
        turns[part] = _solid_angles(nodes[triangles], centers[part]).sum(axis=1)
    inside = np.abs(turns) > 2 * np.pi
    return VoxelGrid(origin, float(spacing), inside.reshape(counts))


def visible(points: ArrayLike, eye: ArrayLike, nodes: ArrayLike, triangles: ArrayLike) -> Array:
    """Return which points no triangle hides, shape (n,), booleans.

    A point on a triangle, such as a node of the same mesh, is not hidden by that.

    Args:
        points: The points, shape (n, 3).
        eye: Where they are seen from, shape (3,).
        nodes: Corners of the triangles, shape (nodes, 3).
        triangles: Numbers of nodes, shape (triangles, 3).

    Raises:
        ConfigError: If a shape is another one.
    """
    points, nodes, triangles = (
        np.asarray(points, float),
        np.asarray(nodes, float),
        np.asarray(triangles),
    )
    _check("points", points, (None, 3))
    _check("nodes", nodes, (None, 3))
    _check("triangles", triangles, (None, 3))
    start = np.asarray(eye, float)
    corner, *others = np.moveaxis(nodes[triangles], 1, 0)
    first, second = (other - corner for other in others)
    normal, away = np.cross(first, second), start - corner
    found = np.empty(len(points), bool)
    for part in _blocks(len(points), len(triangles)):
        sight = points[part] - start
        # Where each line of sight meets each plane (Moller and Trumbore), as its share.
        against = -sight @ normal.T
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (away * normal).sum(axis=1) / against
            turned = np.cross(away, sight[:, None])
            one = (second * turned).sum(axis=2) / against
            two = -(first * turned).sum(axis=2) / against
        hit = (one >= 0) & (two >= 0) & (one + two <= 1) & (share > _CLOSE)
        found[part] = ~(hit & (share < 1 - _HIDING)).any(axis=1)
    return found


def _solid_angles(corners: Array, points: Array) -> Array:
    """Return signed solid angles of triangles from points, shape (points, triangles).

    See Van Oosterom and Strackee, The solid angle of a plane triangle (1983).
    """
    a, b, c = np.moveaxis(corners[None] - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(each, axis=2) for each in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=2)
    ab, bc, ca = ((one * two).sum(axis=2) for one, two in ((a, b), (b, c), (c, a)))
    found: Array = 2 * np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb)
    return found


def _blocks(points: int, cells: int) -> Iterator[slice]:
    """Yield parts of points of which all pairs with cells fit into memory."""
    step = max(1, _BLOCK // max(1, cells))
    return (slice(first, first + step) for first in range(0, points, step))


def _check(name: str, values: Any, shape: tuple[int | None, ...]) -> None:
    """Check a shape, in which None is any number."""
    right = values.ndim == len(shape) and all(
        wanted in (None, found) for wanted, found in zip(shape, values.shape, strict=True)
    )
    if not right:
        wanted = ", ".join("n" if each is None else str(each) for each in shape)
        raise ConfigError(f"{name} have the shape {values.shape}, but should have ({wanted}).")
