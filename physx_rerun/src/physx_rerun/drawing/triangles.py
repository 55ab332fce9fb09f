"""Meshes of few triangles, for pictures that are drawn without a graphics card.

A processor needs most of its time for the triangles of a robot, far more than a picture has pixels.
COLLADA becomes triangles for all pictures: Rerun omits many documents, such as those of MeshLab,
and turns those that call another axis upward, which engines ignore.
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

_MANY = 1000  # triangles, fewer of which are drawn as they are
_ROW, _LAYER = 1 << 20, 1 << 40  # steps of the number of a cell
_WHITE = (1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Triangles:
    """A part of a mesh with one color.

    Attributes:
        points: Corners, shape (triangles, 3, 3), in m.
        normals: Unit normals of the surface at the corners, likewise.
        color: Red, green, blue and alpha in [0, 1].
    """

    points: Array
    normals: Array
    color: tuple[float, ...] = _WHITE


@dataclass(frozen=True)
class SimpleMesh:
    """A mesh that is drawn in place of a file.

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
        detail: Size of what may be lost, in the file's units of length; None: nothing.

    Returns:
        None if the file is best left to the viewer: nothing would be lost, or it has features that
        are not read here, such as textures, or is damaged.
    """
    reader = {".stl": _stl, ".dae": _dae}.get(path.suffix.lower())
    try:
        if reader is None or (reader is _stl and not detail):
            return None
        parts = reader(read_content(path, LARGEST))
        if detail and sum(len(part.points) for part in parts) >= _MANY:
            return _simplify(parts, detail)
        return _whole(parts) if reader is _dae else None
    except Exception:  # strangers' files fail in any way, and the viewer reports it
        return None


def _whole(parts: list[Triangles]) -> SimpleMesh:
    """Return all triangles of parts."""
    points, normals, owner = _corners(parts)
    colors = np.array([part.color for part in parts])[owner]
    return SimpleMesh(points, normals, colors, np.arange(len(points)).reshape(-1, 3))


def _corners(parts: list[Triangles]) -> tuple[Array, Array, Array]:
    """Return corners and normals of all triangles, shape (n, 3), and the parts they are of."""
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
        raise ValueError("the mesh is too large for the size of its details")
    side = np.rint(1.2 * normals).astype(np.int64) @ np.array([9, 3, 1]) + 13
    kinds, corner = np.unique(27 * place + side, return_inverse=True)
    ends = np.sort(place.reshape(-1, 3), axis=1)
    # Where the two faces of a wall fall together, the outer one is kept.
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
    """Return the mean of the rows of each group, shape (groups, 3)."""
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
        if part.nvertices != len(part.index):  # nothing else bounds them
            raise ValueError("polygons of more corners than there are")
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
    """Return a component of a color as screens have it."""
    if linear <= 0.0031308:
        return 12.92 * max(linear, 0.0)
    return 1.055 * min(linear, 1.0) ** (1 / 2.4) - 0.055
