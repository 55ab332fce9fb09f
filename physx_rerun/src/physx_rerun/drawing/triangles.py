"""Meshes with few triangles, for pictures that are drawn without a GPU.

A CPU spends most of its time on a robot's triangles, which far outnumber a picture's pixels.
COLLADA files become triangles for all pictures: Rerun omits many documents, such as those from
MeshLab, and rotates those with another up axis, which engines ignore.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.files import read_content
from physx_core.typing import Array
from physx_rerun.drawing.meshes import LARGEST, facets_of, placed, read_document

_MANY = 1000  # triangles; meshes with fewer are drawn unmodified
_ROW, _LAYER = 1 << 20, 1 << 40  # strides of cell numbers
_WHITE = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Triangles:
    """A part of a mesh with one color.

    Attributes:
        points: Corners, shape (triangles, 3, 3), in m.
        normals: Unit normals of the surface at the corners, shape (triangles, 3, 3).
        color: Red, green, blue and alpha in [0, 1].
    """

    points: Array
    normals: Array
    color: tuple[float, ...] = _WHITE


@dataclass(frozen=True)
class SimpleMesh:
    """A mesh drawn in place of a file.

    Attributes:
        positions: Vertices, shape (n, 3), in m.
        normals: Unit normals there, shape (n, 3).
        colors: Red, green, blue and alpha in [0, 1] there, shape (n, 4).
        cells: Indices of the vertices of each triangle, shape (m, 3).
    """

    positions: Array
    normals: Array
    colors: Array
    cells: Array


@functools.lru_cache(maxsize=64)
def simple_mesh(path: Path, detail: float | None) -> SimpleMesh | None:
    """Return the mesh of a file without details.

    Args:
        path: The file.
        detail: Size of details that may be lost, in the file's unit of length; None: keep all.

    Returns:
        The mesh; None if the viewer should read the file: nothing would be lost, it has features
        that are not supported here, such as textures, or it is damaged.
    """
    reader = {".stl": _stl, ".dae": _dae}.get(path.suffix.lower())
    try:
        if reader is None or (reader is _stl and not detail):
            return None
        parts = reader(read_content(path, LARGEST))
        if detail and sum(len(part.points) for part in parts) >= _MANY:
            return _simplify(parts, detail)
        return _whole(parts) if reader is _dae else None
    except Exception:  # malformed files can fail in any way, and the viewer reports it
        return None


def _whole(parts: list[Triangles]) -> SimpleMesh:
    """Return all triangles of the parts."""
    points, normals, owner = _corners(parts)
    colors = np.array([part.color for part in parts])[owner]
    return SimpleMesh(points, normals, colors, np.arange(len(points)).reshape(-1, 3))


def _corners(parts: list[Triangles]) -> tuple[Array, Array, Array]:
    """Return the corners and normals of all triangles, shape (n, 3), and the corners' parts."""
    points = np.concatenate([part.points for part in parts]).reshape(-1, 3)
    normals = np.concatenate([part.normals for part in parts]).reshape(-1, 3)
    return (
        points,
        normals,
        np.repeat(np.arange(len(parts)), [3 * len(each.points) for each in parts]),
    )


def _simplify(parts: list[Triangles], detail: float) -> SimpleMesh:
    """Merge the vertices of each part in each cell of a grid; edges between sides stay sharp."""
    points, normals, owner = _corners(parts)
    grid = np.floor((points - points.min(axis=0)) / detail).astype(np.int64)
    steps = np.array([_LAYER, _ROW, 1])
    _, cell = np.unique(grid @ steps, return_inverse=True)
    _, place = np.unique(len(parts) * cell + owner, return_inverse=True)
    if max(grid.max(), place.max()) >= _ROW or not np.isfinite(normals).all():
        raise ValueError("the mesh is too large for its smallest details")
    side = np.rint(1.2 * normals).astype(np.int64) @ np.array([9, 3, 1]) + 13
    kinds, corner = np.unique(27 * place + side, return_inverse=True)
    ends = np.sort(place.reshape(-1, 3), axis=1)
    # Where the two faces of a wall coincide, the outer one is kept.
    outwards = np.einsum("ij,ij->i", normals, points - points.mean(axis=0)).reshape(-1, 3).sum(1)
    order = np.argsort(-outwards)
    first = order[np.unique(ends[order] @ steps, return_index=True)[1]]
    kept = first[(ends[first, 0] != ends[first, 1]) & (ends[first, 1] != ends[first, 2])]
    owners = np.zeros(len(kinds), np.int64)
    owners[corner] = owner
    return SimpleMesh(
        _means(points, place)[kinds // 27],
        _means(normals, corner),
        np.array([part.color for part in parts])[owners],
        corner.reshape(-1, 3)[kept],
    )


def _means(values: Array, groups: Array) -> Array:
    """Return the mean of each group's rows, shape (groups, 3)."""
    counts = np.bincount(groups)
    return np.stack([np.bincount(groups, axis) / counts for axis in values.T], axis=1)


def _stl(content: bytes) -> list[Triangles]:
    points = facets_of(content)
    return [] if points is None else [Triangles(points, _flat(points))]


def _flat(points: Array) -> Array:
    """Return the unit normals of triangles at each of their corners."""
    faces = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return np.repeat(_unit(faces)[:, np.newaxis], 3, axis=1)


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _dae(content: bytes) -> list[Triangles]:
    document = read_document(content)
    from collada.lineset import BoundLineSet

    textured = document.xmlnode.find(f".//{document.tag('texture')}") is not None
    if document.errors or textured:
        raise ValueError("damaged, or with textures")
    meter = document.assetInfo.unitmeter or 1.0
    parts = placed(document)
    return [_triangles(part, meter) for part in parts if not isinstance(part, BoundLineSet)]


def _triangles(part: Any, meter: float) -> Triangles:
    """Return the triangles of a placed part of a document."""
    if hasattr(part, "polygons"):
        if part.nvertices != len(part.index):  # not validated elsewhere
            raise ValueError("polygons with more corners than there are")
        part = part.triangleset()
    points = meter * part.vertex[part.vertex_index].astype(np.float64)
    normals = part.normal
    normals = _flat(points) if normals is None else _unit(normals[part.normal_index])
    color = None if part.material is None else part.material.effect.diffuse
    if color is None:
        return Triangles(points, normals)
    red, green, blue, alpha = color
    return Triangles(points, normals, (_to_srgb(red), _to_srgb(green), _to_srgb(blue), alpha))


def _to_srgb(linear: float) -> float:
    """Convert a color component to sRGB."""
    if linear <= 0.0031308:
        return 12.92 * max(linear, 0.0)
    return 1.055 * min(linear, 1.0) ** (1 / 2.4) - 0.055
