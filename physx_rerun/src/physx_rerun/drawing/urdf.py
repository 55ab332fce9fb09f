"""URDF: the visual shapes of a robot and where they sit on its links."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physx_core.errors import VisualizerError
from physx_core.typing import Array

MESH_TYPES = {
    ".dae": "model/vnd.collada+xml",
    ".glb": "model/gltf-binary",
    ".gltf": "model/gltf+json",
    ".obj": "model/obj",
    ".stl": "model/stl",
}
"""Mesh files that Rerun can draw, by suffix, and their media types."""


@dataclass(frozen=True)
class Shape:
    """One visual shape.

    Attributes:
        name: Name that is unique in the robot.
        body: Body that it sits on, an index into the bodies given; None: it stands in the world.
        pose: Its pose in the body's frame, a homogeneous matrix of shape (4, 4).
        kind: ``mesh``, ``box``, ``cylinder``, ``sphere`` or ``capsule``.
        size: Scale of a mesh, half sizes of a box, or radius and length, in m.
        mesh: File of a mesh.
        color: Red, green, blue and alpha in [0, 1] that the URDF gives; None: none given.
    """

    name: str
    body: int | None
    pose: Array
    kind: str
    size: tuple[float, ...]
    mesh: Path | None
    color: tuple[float, ...] | None


@dataclass(frozen=True)
class Model:
    """What is drawn of a robot.

    Attributes:
        shapes: The visual shapes whose files exist.
        missing: Names of mesh files that do not exist or that Rerun cannot draw.
        rest: Poses of the bodies with all joints at zero and the root at the origin,
            shape (bodies, 7), x, y, z in m and quaternion x, y, z, w.
    """

    shapes: list[Shape]
    missing: list[str]
    rest: Array


def read(urdf: str | Path, bodies: Sequence[str], package_dirs: Mapping[str, str]) -> Model:
    """Read the visual shapes of a URDF file; collision shapes are left out.

    Args:
        urdf: The file.
        bodies: Names of the links that are placed; a link that is not among them moves with the
            nearest of its ancestors that is, its joints at zero.
        package_dirs: Folder of each package that mesh names begin with.

    Raises:
        VisualizerError: The file cannot be read, or has no link of a body's name.
    """
    path = Path(urdf)
    try:
        root = ET.fromstring(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, ET.ParseError) as error:
        raise VisualizerError(f"The robot {path} cannot be drawn: {error}.") from error
    links = {link.get("name", ""): link for link in root.findall("link")}
    unknown = [name for name in bodies if name not in links]
    if unknown:
        raise VisualizerError(f"{path} has no link {unknown[0]!r}. Links: {', '.join(links)}.")
    carriers = _carriers(root, links, bodies)
    rest = np.array([_pose7(_rest(root, name)) for name in bodies]).reshape(-1, 7)
    materials = {
        material.get("name"): color
        for material in root.iter("material")
        if (color := _color(material)) is not None
    }
    shapes: list[Shape] = []
    missing: list[str] = []
    for name, link in links.items():
        body, offset = carriers[name]
        for number, visual in enumerate(link.findall("visual")):
            kind, size, file = _geometry(visual)
            mesh = _mesh_path(file, path.parent, package_dirs) if file else None
            if mesh is not None and not (mesh.is_file() and mesh.suffix.lower() in MESH_TYPES):
                missing.append(str(file))
                continue
            color = _material(visual, materials)
            pose = offset @ _origin(visual)
            shapes.append(Shape(f"{name}_{number}", body, pose, kind, size, mesh, color))
    return Model(shapes, missing, rest)


def _parents(root: ET.Element) -> dict[str, tuple[str, Array]]:
    found: dict[str, tuple[str, Array]] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            found[child.get("link", "")] = (parent.get("link", ""), _origin(joint))
    return found


def _carriers(
    root: ET.Element, links: Mapping[str, ET.Element], bodies: Sequence[str]
) -> dict[str, tuple[int | None, Array]]:
    index, parents = {name: number for number, name in enumerate(bodies)}, _parents(root)
    carriers: dict[str, tuple[int | None, Array]] = {}
    for name in links:
        at, offset = name, np.eye(4)
        while at not in index and at in parents:
            at, step = parents[at]
            offset = step @ offset
        carriers[name] = (index.get(at), offset)
    return carriers


def _rest(root: ET.Element, link: str) -> Array:
    parents, pose = _parents(root), np.eye(4)
    while link in parents:
        link, step = parents[link]
        pose = step @ pose
    return pose


def _numbers(text: str | None, default: str) -> list[float]:
    return [float(part) for part in (text or default).split()]


def _origin(element: ET.Element) -> Array:
    origin = element.find("origin")
    xyz = _numbers(origin.get("xyz") if origin is not None else None, "0 0 0")
    rpy = _numbers(origin.get("rpy") if origin is not None else None, "0 0 0")
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    pose = np.eye(4)
    pose[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    pose[:3, 3] = xyz
    return pose


def quaternion(rotation: Array) -> Array:
    """Return the unit quaternion x, y, z, w of a rotation matrix of shape (3, 3).

    It is the eigenvector of the largest eigenvalue of a symmetric matrix made of the rotation's
    entries (I. Y. Bar-Itzhack, Journal of Guidance, Control, and Dynamics 23, 2000).
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    vector = np.linalg.eigh(matrix)[1][:, -1]
    return vector if vector[3] >= 0 else -vector


def _pose7(matrix: Array) -> Array:
    return np.concatenate([matrix[:3, 3], quaternion(matrix[:3, :3])])


def _geometry(visual: ET.Element) -> tuple[str, tuple[float, ...], str | None]:
    geometry = visual.find("geometry")
    shape = geometry[0] if geometry is not None and len(geometry) else None
    kind = shape.tag if shape is not None else "nothing"
    if shape is None or kind not in ("mesh", "box", "cylinder", "sphere", "capsule"):
        raise VisualizerError(f"A URDF visual has the shape <{kind}>, which cannot be drawn.")
    if kind == "mesh":
        return kind, tuple(_numbers(shape.get("scale"), "1 1 1")), shape.get("filename", "")
    if kind == "box":
        return kind, tuple(side / 2 for side in _numbers(shape.get("size"), "1 1 1")), None
    radius, length = (float(shape.get(name, "0")) for name in ("radius", "length"))
    return kind, (radius, length), None


def _mesh_path(file: str, folder: Path, package_dirs: Mapping[str, str]) -> Path:
    if not file.startswith("package://"):
        return folder / file.removeprefix("file://")
    package, _, rest = file.removeprefix("package://").partition("/")
    if package in package_dirs:
        return Path(package_dirs[package]) / rest
    near = [parent for parent in folder.resolve().parents if parent.name == package]
    return (near[0] if near else folder) / rest


def _color(material: ET.Element) -> tuple[float, ...] | None:
    color = material.find("color")
    return tuple(_numbers(color.get("rgba"), "1 1 1 1")) if color is not None else None


def _material(
    visual: ET.Element, materials: Mapping[str | None, tuple[float, ...]]
) -> tuple[float, ...] | None:
    material = visual.find("material")
    if material is None:
        return None
    return _color(material) or materials.get(material.get("name"))
