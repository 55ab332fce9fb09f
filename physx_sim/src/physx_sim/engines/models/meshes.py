"""Vertices and triangles of mesh files, and the boxes and capsules around them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import files
from physx_core.origin import install_hint
from physx_core.processes import TemporaryFolder
from physx_core.typing import Vector
from physx_sim.errors import ModelError

_FORMATS = (".stl", ".obj", ".dae", ".msh")
_LARGEST = 2**27
"""Maximum size of a mesh file, in bytes; loading takes several times as much memory."""
_GEOMETRY = ([b"v"], [b"vn"], [b"vt"], [b"f"], [b"o"], [b"g"])


def read_vertices(path: Path, scale: Sequence[float]) -> Vector:
    """Return the vertices of a mesh file, shape (n, 3), in m.

    Args:
        path: Path of an stl, obj, dae, or msh file.
        scale: Scale factor along each axis.

    Raises:
        ModelError: If the file is missing, too large, damaged, or in another format, has no
            vertices or some that are not finite, or the package coal is not installed.
    """
    return _vertices(path, _read(path, scale))


def read_triangles(path: Path, scale: Sequence[float]) -> Vector:
    """Return the corners of the triangles of a mesh file, shape (n, 3, 3), in m.

    Args:
        path: Path of an stl, obj, dae, or msh file.
        scale: Scale factor along each axis.

    Raises:
        ModelError: As `read_vertices`.
    """
    mesh = _read(path, scale)
    vertices = _vertices(path, mesh)
    corners = [[mesh.tri_indices(i)[k] for k in range(3)] for i in range(mesh.num_tris)]
    return vertices[np.array(corners, np.intp).reshape(-1, 3)]


def _read(path: Path, scale: Sequence[float]) -> Any:
    if not path.is_file():
        raise ModelError(f"There is no mesh file {path}.")
    if path.suffix.lower() not in _FORMATS:
        raise ModelError(f"The mesh {path} is not in one of the formats {', '.join(_FORMATS)}.")
    if path.stat().st_size > _LARGEST:
        raise ModelError(f"The mesh {path} has more than {_LARGEST} bytes: simplify it.")
    try:
        import coal  # only worlds with meshes need it
    except ImportError as error:
        raise ModelError(
            f"The mesh {path} is read with the package coal, which cannot be imported: {error}. "
            f"{install_hint('physx-sim', 'meshes')}"
        ) from error
    try:
        with geometry_file(path) as bare:
            return coal.MeshLoader().load(str(bare), np.array(scale, np.float64))
    except (ValueError, RuntimeError, TypeError) as error:
        raise ModelError(f"The mesh {path} cannot be read: {error}") from error


def _vertices(path: Path, mesh: Any) -> Vector:
    vertices = np.array(mesh.vertices(), np.float64).reshape(-1, 3)
    if not len(vertices) or not np.isfinite(vertices).all():
        raise ModelError(f"The mesh {path} has no vertices, or some that are not finite.")
    return vertices


@contextmanager
def geometry_file(path: Path) -> Iterator[Path]:
    """Yield a file with the vertices and faces of a mesh that refers to no other file.

    An obj file can refer to material files anywhere, which the engines' libraries would read. They
    cannot read MuJoCo's format, msh, so it is converted to obj.

    Raises:
        ModelError: If an msh file is damaged.
    """
    suffix = path.suffix.lower()
    if suffix not in (".obj", ".msh"):
        yield path
        return
    kept = _bare(path.read_bytes()) if suffix == ".obj" else _converted(path)
    with TemporaryFolder("mesh-") as folder:
        bare = folder.path / path.with_suffix(".obj").name
        files.replace(bare, kept, wait=False)
        yield bare


def _bare(content: bytes) -> bytes:
    """Return the vertices and faces of an obj file."""
    joined = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    lines = joined.splitlines(keepends=True)
    return b"".join(line for line in lines if line.split(None, 1)[:1] in _GEOMETRY)


def _converted(path: Path) -> bytes:
    """Return the vertices and faces of an msh file as an obj file.

    It contains, little-endian, the numbers of vertices, normals, texture coordinates and faces
    (4 int32), then these as float32 (3, 3 and 2 each) and int32 (3 each).
    """
    content = path.read_bytes()
    header = np.frombuffer(content[:16] if len(content) >= 16 else b"", "<i4")
    if len(header) == 4 and (header >= 0).all():
        vertices, normals, textures, faces = header.tolist()
        begin = 16 + 12 * vertices
        end = begin + 12 * normals + 8 * textures
        if len(content) == end + 12 * faces:
            points = np.frombuffer(content[16:begin], "<f4").reshape(-1, 3)
            corners = np.frombuffer(content[end:], "<i4").reshape(-1, 3)
            if not faces or (corners.min() >= 0 and corners.max() < vertices):
                lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
                lines += [f"f {a} {b} {c}" for a, b, c in (corners + 1).tolist()]
                return "\n".join([*lines, ""]).encode("ascii")
    raise ModelError(f"The mesh {path} is not an msh file of MuJoCo, or it is damaged.")


def bounding_box(vertices: Vector) -> tuple[Vector, Vector]:
    """Return the center and full size, shape (3,) each, of the bounding box of vertices (n, 3)."""
    lowest, highest = vertices.min(axis=0), vertices.max(axis=0)
    return 0.5 * (lowest + highest), np.maximum(highest - lowest, 1e-4)


def bounding_capsule(vertices: Vector) -> tuple[Vector, Vector, Vector]:
    """Return a capsule that bounds vertices (n, 3), along their bounding box's longest edge.

    Returns:
        Center (3,), axes (3, 3) with the capsule's axis as last column, and radius and length of
        the cylindrical part (2,), in m; a length of 0 means a sphere.
    """
    center, size = bounding_box(vertices)
    axis = int(np.argmax(size))
    axes = np.roll(np.eye(3), 2 - axis, axis=1)
    local = (vertices - center) @ axes
    squares = (local[:, :2] ** 2).sum(axis=1)
    radius = max(float(np.sqrt(squares.max())), 1e-4)
    reach = np.abs(local[:, 2]) - np.sqrt(np.maximum(radius**2 - squares, 0.0))
    return center, axes, np.array([radius, max(2 * float(reach.max()), 0.0)])
