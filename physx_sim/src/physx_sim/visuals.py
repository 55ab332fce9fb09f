"""Reads the visual shapes of a URDF file, and their poses on the robot's bodies, for viewers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from physx_core.rotations import from_matrix_rows
from physx_core.typing import Vector
from physx_sim.errors import ModelError
from physx_sim.urdf import UrdfTree, link_of, mesh_path, numbers_of, origin_of, parse_urdf


@dataclass(frozen=True)
class VisualShape:
    """A visual shape of a link.

    Attributes:
        name: Name that is unique in the robot.
        body: Index of the body that it is attached to; None: the world.
        pose: Pose in the body's frame, a homogeneous matrix of shape (4, 4).
        kind: ``mesh``, ``box``, ``cylinder``, ``sphere`` or ``capsule``.
        size: In m: half edges of a box (3,); radius of a sphere (1,); radius and length (2,). For a
            mesh: scale factors (3,).
        mesh: File of a mesh.
        color: Red, green, blue and alpha in [0, 1] from the URDF; None: not specified there.
    """

    name: str
    body: int | None
    pose: Vector
    kind: str
    size: tuple[float, ...]
    mesh: Path | None
    color: tuple[float, ...] | None


@dataclass(frozen=True)
class VisualModel:
    """What of a robot is drawn.

    Attributes:
        shapes: The visual shapes whose files exist.
        missing: Names of mesh files that do not exist or are of another type.
        rest: Poses of the bodies with all joints at zero and the root at the origin,
            shape (bodies, 7), x, y, z in m and quaternion x, y, z, w.
    """

    shapes: list[VisualShape]
    missing: list[str]
    rest: Vector


def read_visuals(
    urdf: str | Path,
    bodies: Sequence[str],
    package_dirs: Mapping[str, str],
    mesh_types: Collection[str],
) -> VisualModel:
    """Read the visual shapes of a URDF file; collision shapes are ignored.

    Args:
        urdf: The file.
        bodies: Names of the links to place; other links move with their nearest ancestor among
            these, with joints at zero.
        package_dirs: Folder of each package that mesh names start with.
        mesh_types: Suffixes of the mesh files that the viewer can draw, such as ``.stl``.

    Raises:
        ModelError: If the file cannot be read, or has no such body.
    """
    path = Path(urdf).absolute()
    tree = UrdfTree(parse_urdf(path))
    unknown = [name for name in bodies if name not in tree.elements]
    if unknown:
        raise ModelError(f"it has no link {unknown[0]!r}; links: {', '.join(tree.elements)}")
    carriers = {name: _carrier(tree, name, bodies) for name in tree.elements}
    poses = np.array([_carrier(tree, name, ())[1] for name in bodies]).reshape(-1, 4, 4)
    rest = np.concatenate([poses[:, :3, 3], from_matrix_rows(poses[:, :3, :3])], axis=1)
    materials = {
        material.get("name"): color
        for material in tree.root.iter("material")
        if (color := _color(material)) is not None
    }
    shapes: list[VisualShape] = []
    missing: list[str] = []
    for name, link in tree.elements.items():
        body, offset = carriers[name]
        visuals = zip(tree.shapes(name, "visual"), link.findall("visual"), strict=True)
        for number, (shape, visual) in enumerate(visuals):
            mesh = None
            if shape.kind == "mesh":
                mesh = mesh_path(path, shape.mesh, package_dirs)
                if mesh is None or not (mesh.is_file() and mesh.suffix.lower() in mesh_types):
                    missing.append(shape.mesh)
                    continue
            size = tuple(0.5 * edge for edge in shape.size) if shape.kind == "box" else shape.size
            color, pose = _material(visual, materials), offset @ shape.pose
            shapes.append(
                VisualShape(f"{name}_{number}", body, pose, shape.kind, size, mesh, color)
            )
    return VisualModel(shapes, missing, rest)


def _carrier(tree: UrdfTree, link: str, bodies: Sequence[str]) -> tuple[int | None, Vector]:
    """Return the body that a link moves with (None: the root link), and its pose (4, 4) there."""
    offset = np.eye(4)
    while link not in bodies and link in tree.parents:
        joint = tree.parents[link]
        offset = origin_of(f'joint "{joint.get("name")}"', joint) @ offset
        link = link_of(joint, "parent")
    return (bodies.index(link) if link in bodies else None), offset


def _color(material: Element) -> tuple[float, ...] | None:
    color = material.find("color")
    return None if color is None else tuple(numbers_of("a color", color, "rgba", "1 1 1 1", 4))


def _material(
    visual: Element, materials: Mapping[str | None, tuple[float, ...]]
) -> tuple[float, ...] | None:
    material = visual.find("material")
    if material is None:
        return None
    return _color(material) or materials.get(material.get("name"))
