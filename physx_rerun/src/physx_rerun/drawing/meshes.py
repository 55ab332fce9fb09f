"""Extents of mesh files, so that the camera shows all of them."""

from __future__ import annotations

import functools
import json
import struct
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from physx_core.typing import Array
from physx_rerun.drawing.framing import extremes

_LARGEST = 2**26
"""Bytes of a mesh file; of larger ones only the origin is shown for certain."""
_NOTHING = np.zeros((1, 3))
PLACEMENTS = ("matrix", "translate", "scale", "rotate")
"""Steps of the placement of a node of COLLADA."""


@functools.lru_cache(maxsize=256)
def corners_of_mesh(path: Path) -> Array:
    """Return the opposite corners of the box around a mesh, shape (2, 3), in its own units.

    The origin alone, shape (1, 3), stands for a file that cannot be read: the viewer will say so.
    """
    try:
        if path.stat().st_size > _LARGEST:
            return _NOTHING
        points = _READERS[path.suffix.lower()](path)
    except (OSError, ValueError, KeyError, TypeError, IndexError, struct.error, SyntaxError):
        return _NOTHING
    points = points[np.isfinite(points).all(axis=1)]
    return np.stack(extremes(points)) if len(points) else _NOTHING


def _stl(path: Path) -> Array:
    content = path.read_bytes()
    count = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * count:
        kind = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
        facets = np.frombuffer(content, kind, offset=84)
        return np.asarray(facets["numbers"][:, 1:].reshape(-1, 3), np.float64)
    return _rows(content, b"vertex")


def _obj(path: Path) -> Array:
    return _rows(path.read_bytes(), b"v")


def _rows(content: bytes, word: bytes) -> Array:
    """Return the three numbers after a word at the beginning of lines."""
    lines = (line.split() for line in content.splitlines())
    return np.array([row[1:4] for row in lines if row[:1] == [word]], np.float64).reshape(-1, 3)


def _gltf(path: Path) -> Array:
    content = path.read_bytes()
    if content[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    scene = json.loads(content)
    places = {
        primitive["attributes"]["POSITION"]
        for mesh in scene["meshes"]
        for primitive in mesh["primitives"]
    }
    found = [scene["accessors"][place][end] for place in places for end in ("min", "max")]
    return np.array(found, np.float64).reshape(-1, 3)


def _dae(path: Path) -> Array:
    content = path.read_bytes()
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        return _NOTHING
    root = ElementTree.fromstring(content)
    tag = root.tag.removesuffix("COLLADA")
    unit = root.find(f"{tag}asset/{tag}unit")
    meter = 1.0 if unit is None else float(unit.get("meter", "1"))
    meshes = {each.get("id"): _positions(each, tag) for each in root.iter(f"{tag}geometry")}
    found = [_NOTHING[:0]]
    nodes = [(node, np.eye(4)) for node in root.iterfind(f".//{tag}visual_scene/{tag}node")]
    while nodes:
        node, pose = nodes.pop()
        for part in node:
            kind = part.tag.removeprefix(tag)
            if kind in PLACEMENTS:
                pose = pose @ placement(kind, np.array((part.text or "").split(), np.float64))
            elif kind == "node":
                nodes.append((part, pose))
            elif kind == "instance_geometry":
                points = meshes.get(part.get("url", "").removeprefix("#"), _NOTHING[:0])
                found.append(points @ pose[:3, :3].T + pose[:3, 3])
    return meter * np.concatenate(found)


def placement(kind: str, numbers: Array) -> Array:
    """Return a step of a node's placement as a homogeneous matrix (4, 4)."""
    if kind == "matrix":
        return numbers.reshape(4, 4)
    matrix = np.eye(4)
    if kind == "translate":
        matrix[:3, 3] = numbers
    elif kind == "scale":
        matrix[[0, 1, 2], [0, 1, 2]] = numbers
    else:
        x, y, z = numbers[:3] / np.linalg.norm(numbers[:3])
        across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        angle = np.radians(numbers[3])
        matrix[:3, :3] += np.sin(angle) * across + (1 - np.cos(angle)) * across @ across
    return matrix


def _positions(geometry: ElementTree.Element, tag: str) -> Array:
    named = {source.get("id"): source for source in geometry.iter(f"{tag}source")}
    for read in geometry.iterfind(f".//{tag}vertices/{tag}input[@semantic='POSITION']"):
        numbers = named[read.get("source", "").removeprefix("#")].find(f"{tag}float_array")
        if numbers is not None:
            return np.array((numbers.text or "").split(), np.float64).reshape(-1, 3)
    return _NOTHING[:0]


_READERS = {".stl": _stl, ".obj": _obj, ".dae": _dae, ".glb": _gltf, ".gltf": _gltf}
