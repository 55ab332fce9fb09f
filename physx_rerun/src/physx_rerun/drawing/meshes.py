"""Mesh files: their extents, which the camera keeps in view, and their parts."""

from __future__ import annotations

import functools
import io
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.files import read_content
from physx_core.rotations import rotate_rows
from physx_core.typing import Array
from physx_rerun.drawing.framing import extremes

if TYPE_CHECKING:
    from collada import Collada

LARGEST = 2**26
"""Largest size of a mesh file in bytes; of larger ones, only the origin is sure to be in view."""
_MOST = 2**24  # points in a document, which can repeat its shapes endlessly
_MOST_NODES = 2**14
_MOST_ITEMS = 2**20  # tags or JSON items, which take many times more memory than their text
_NOTHING = np.zeros((1, 3))
_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


@functools.lru_cache(maxsize=256)
def corners_of_mesh(path: Path) -> Array:
    """Return the opposite corners of the box around a mesh, shape (2, 3), in its own units.

    The origin alone, shape (1, 3), if the file cannot be read; the viewer reports that.
    """
    try:
        found = [_NOTHING[:0]]
        for points in _READERS[path.suffix.lower()](read_content(path, LARGEST)):
            finite = points[np.isfinite(points).all(axis=1)]
            found += [np.stack(extremes(finite))] if len(finite) else []
        corners = np.concatenate(found)
        return np.stack(extremes(corners)) if len(corners) else _NOTHING
    except Exception:  # malformed files can fail in any way
        return _NOTHING


def facets_of(content: bytes) -> Array | None:
    """Return the corners of a binary STL file's triangles, shape (n, 3, 3); None if it is text."""
    if len(content) != 84 + 50 * int.from_bytes(content[80:84], "little"):
        return None
    kind = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])
    return np.asarray(np.frombuffer(content, kind, offset=84)["numbers"][:, 1:], np.float64)


def read_document(content: bytes) -> Collada:
    """Return a COLLADA document without damaged parts, which are listed in its ``errors``.

    Raises:
        ValueError: If it is compressed, or may expand to something much larger.
    """
    # Zip files, which pycollada would unpack, and UTF-16 contain zero bytes.
    bombs = b"\0", b"<!DOCTYPE", b"instance_node"
    if content.count(b"<") > _MOST_ITEMS or any(word in content for word in bombs):
        raise ValueError("a document that may be a decompression bomb")
    import collada  # needed only for documents

    return collada.Collada(io.BytesIO(content), ignore=[collada.DaeError])


def placed(document: Collada) -> list[Any]:
    """Return the parts of all shapes in a document's scenes, placed, in its unit of length."""
    found, count = [], 0
    for scene in document.scenes:
        for shape in scene.objects("geometry"):
            for part in shape.primitives():
                found.append(part)
                count += len(part.vertex)
                if count > _MOST:
                    raise ValueError(f"a document with more than {_MOST} points")
    return found


def _stl(content: bytes) -> Iterator[Array]:
    facets = facets_of(content)
    return _rows(content, b"vertex") if facets is None else iter([facets.reshape(-1, 3)])


def _obj(content: bytes) -> Iterator[Array]:
    return _rows(content, b"v")


def _rows(content: bytes, word: bytes) -> Iterator[Array]:
    """Yield the three numbers after a word at the start of lines, in small blocks."""
    file = io.BytesIO(content)
    while lines := file.readlines(2**20):
        rows = [line[:256].split(None, 4) for line in lines]
        found = [row[1:4] for row in rows if row[:1] == [word]]
        yield np.array(found, np.float64).reshape(-1, 3)


def _dae(content: bytes) -> Iterator[Array]:
    document = read_document(content)
    meter = document.assetInfo.unitmeter or 1.0
    # With damaged materials, shapes are not placed in a scene.
    for part in placed(document) or [
        part for each in document.geometries for part in each.primitives
    ]:
        yield meter * part.vertex


def _gltf(content: bytes) -> Iterator[Array]:
    if content[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    if content.count(b",") > _MOST_ITEMS:
        raise ValueError("a document with too many items")
    document = json.loads(content)
    places = [(root, np.eye(4)) for scene in document["scenes"] for root in scene["nodes"]]
    for number, pose in places:
        node = document["nodes"][number]
        pose = pose @ _pose(node)
        mesh = document["meshes"][node["mesh"]] if "mesh" in node else {"primitives": ()}
        for part in mesh["primitives"]:
            box = document["accessors"][part["attributes"]["POSITION"]]
            corners = np.where(_SIGNS > 0, box["max"], box["min"])
            yield corners @ pose[:3, :3].T + pose[:3, 3]
        places += [(child, pose) for child in node.get("children", ())]
        if len(places) > _MOST_NODES:
            raise ValueError("a document whose nodes are not a tree, or too many")


def _pose(node: dict[str, Any]) -> Array:
    """Return the pose of a glTF node as a homogeneous matrix (4, 4)."""
    if "matrix" in node:
        return np.reshape(np.array(node["matrix"], np.float64), (4, 4)).T
    pose = np.eye(4)
    turn = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    pose[:3, :3] = rotate_rows(turn, np.diag(node.get("scale", (1.0, 1.0, 1.0)))).T
    pose[:3, 3] = node.get("translation", (0, 0, 0))
    return pose


_READERS = {".stl": _stl, ".obj": _obj, ".dae": _dae, ".glb": _gltf, ".gltf": _gltf}
