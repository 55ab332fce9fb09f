"""Meshes of few triangles, for pictures that are drawn without a graphics card.

A processor needs most of its time for the triangles of a robot, far more than a picture has pixels.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from physx_core.typing import Array
from physx_rerun.drawing.meshes import PLACEMENTS, placement

_LARGEST = 2**26  # bytes of a file
_MANY = 1000  # triangles, fewer of which are drawn as they are
_ROW, _LAYER = 1 << 20, 1 << 40  # steps of the number of a cell
_WHITE = (1.0, 1.0, 1.0, 1.0)

Element = ElementTree.Element


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
    """A mesh without details.

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
def simple_mesh(path: Path, detail: float) -> SimpleMesh | None:
    """Return the mesh of a file without details.

    Args:
        path: The file.
        detail: Size of what may be lost, in the file's units of length.

    Returns:
        None if the file is best left to the viewer: it has few triangles, or features that are not
        read here, such as textures, or is damaged.
    """
    reader = {".stl": _stl, ".dae": _dae}.get(path.suffix.lower())
    try:
        if reader is None or path.stat().st_size > _LARGEST:
            return None
        parts = reader(path)
        if sum(len(part.points) for part in parts) < _MANY:
            return None
        return _simplify(parts, detail)
    except Exception:  # strangers' files fail in any way, and the viewer reports it
        return None


def _simplify(parts: list[Triangles], detail: float) -> SimpleMesh:
    """Merge the vertices of each part in each cell of a grid; edges between sides stay sharp."""
    points = np.concatenate([part.points for part in parts]).reshape(-1, 3)
    normals = np.concatenate([part.normals for part in parts]).reshape(-1, 3)
    owner = np.repeat(np.arange(len(parts)), [3 * len(part.points) for part in parts])
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


# Files ----------------------------------------------------------------------------------------


def _stl(path: Path) -> list[Triangles]:
    content = path.read_bytes()
    if len(content) != 84 + 50 * int.from_bytes(content[80:84], "little"):
        raise ValueError("a text")
    kind = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    points = np.frombuffer(content, kind, offset=84)["numbers"][:, 1:].astype(np.float64)
    return [Triangles(points, _flat(points))]


def _flat(points: Array) -> Array:
    """Return the unit normals of triangles at each of their corners."""
    faces = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-30)
    return np.repeat(faces[:, np.newaxis], 3, axis=1)


def _dae(path: Path) -> list[Triangles]:
    content = path.read_bytes()
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise ValueError("entities")
    return list(_Collada(ElementTree.fromstring(content)).parts())


class _Collada:
    """Reads the triangles of a COLLADA document; a `ValueError` says that it has more than that."""

    def __init__(self, root: Element) -> None:
        self._tag = root.tag.removesuffix("COLLADA")
        self._root = root
        self._named = {f"#{each.get('id')}": each for each in root.iter() if each.get("id")}

    def parts(self) -> Iterator[Triangles]:
        """Yield the parts of all scenes."""
        for unread in ("texture", "instance_node", "instance_controller", "skew", "lookat"):
            if next(self._root.iter(self._tag + unread), None) is not None:
                raise ValueError(unread)
        asset = self._one(self._root, "asset")
        up, unit = (next(self._all(asset, name), None) for name in ("up_axis", "unit"))
        if up is not None and up.text != "Z_UP":
            raise ValueError("another direction upwards")
        meter = 1.0 if unit is None else float(unit.get("meter", "1"))
        for scene in self._root.iter(f"{self._tag}visual_scene"):
            for node in self._all(scene, "node"):
                yield from self._node(node, np.diag([meter, meter, meter, 1.0]))

    def _all(self, parent: Element, name: str) -> Iterator[Element]:
        return iter(parent.findall(self._tag + name))

    def _one(self, parent: Element, name: str) -> Element:
        found = parent.find(self._tag + name)
        if found is None:
            raise ValueError(f"no {name}")
        return found

    def _node(self, node: Element, pose: Array) -> Iterator[Triangles]:
        for part in node:
            kind = part.tag.removeprefix(self._tag)
            if kind in PLACEMENTS:
                pose = pose @ placement(kind, np.array((part.text or "").split(), np.float64))
        for child in self._all(node, "node"):
            yield from self._node(child, pose)
        for instance in self._all(node, "instance_geometry"):
            materials = {
                each.get("symbol"): each.get("target")
                for each in instance.iter(f"{self._tag}instance_material")
            }
            mesh = self._one(self._named[instance.get("url", "")], "mesh")
            for primitive in mesh:
                kind = primitive.tag.removeprefix(self._tag)
                if kind in ("triangles", "polylist"):
                    color = self._color(materials.get(primitive.get("material")))
                    yield self._triangles(primitive, pose, color)
                elif kind not in ("source", "vertices", "lines", "extra"):
                    raise ValueError(kind)

    def _triangles(self, primitive: Element, pose: Array, color: tuple[float, ...]) -> Triangles:
        inputs = {
            each.get("semantic"): (int(each.get("offset", "0")), each.get("source", ""))
            for each in self._all(primitive, "input")
        }
        stride = 1 + max(offset for offset, _ in inputs.values())
        numbers = np.array((self._one(primitive, "p").text or "").split(), np.int64)
        numbers = numbers.reshape(-1, stride)
        counts = primitive.find(f"{self._tag}vcount")
        if counts is None:
            corners = numbers.reshape(-1, 3, stride)
        else:
            corners = numbers[_fans(np.array((counts.text or "").split(), np.int64))]
        offset, source = inputs["VERTEX"]
        sources = {
            each.get("semantic"): each.get("source", "")
            for each in self._all(self._named[source], "input")
        }
        points = self._floats(sources["POSITION"])[corners[..., offset]]
        points = points @ pose[:3, :3].T + pose[:3, 3]
        offset, source = inputs.get("NORMAL", (offset, sources.get("NORMAL", "")))
        if not source:
            return Triangles(points, _flat(points), color)
        normals = self._floats(source)[corners[..., offset]] @ np.linalg.inv(pose[:3, :3])
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
        return Triangles(points, normals, color)

    def _floats(self, source: str) -> Array:
        array = self._one(self._named[source], "float_array")
        return np.array((array.text or "").split(), np.float64).reshape(-1, 3)

    def _color(self, material: str | None) -> tuple[float, ...]:
        if material is None:
            return _WHITE
        effect = self._one(self._named[material], "instance_effect")
        for diffuse in self._named[effect.get("url", "")].iter(f"{self._tag}diffuse"):
            for color in self._all(diffuse, "color"):
                red, green, blue, alpha = map(float, (color.text or "").split())
                return _to_srgb(red), _to_srgb(green), _to_srgb(blue), alpha
        return _WHITE


def _to_srgb(linear: float) -> float:
    """Return a component of a color as screens have it."""
    if linear <= 0.0031308:
        return 12.92 * max(linear, 0.0)
    return 1.055 * min(linear, 1.0) ** (1 / 2.4) - 0.055


def _fans(counts: Array) -> Array:
    """Return the places of the corners of triangles that make up polygons, shape (triangles, 3)."""
    sizes = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, sizes)
    second = first + np.arange(len(first)) - np.repeat(np.cumsum(sizes) - sizes, sizes) + 1
    return np.stack([first, second, second + 1], axis=1)
