"""Collision shapes of robots and objects, the same for all engines."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_sim import Box, Capsule, Cylinder, Mesh, Robot, Sphere, Stairs, UrdfTree, WorldObject
from physx_sim.description.ground import MATERIAL
from physx_sim.engines.models.meshes import bounding_box, bounding_capsule, read_vertices
from physx_sim.engines.models.robot_files import mesh_path
from physx_sim.errors import ModelError


@dataclass(frozen=True, eq=False)
class CollisionShape:
    """A collision shape of a body.

    Attributes:
        kind: ``box``, ``sphere``, ``capsule``, ``cylinder`` or ``mesh``.
        size: In m: edges of a box (3,); radius of a sphere (1,); radius and length of the
            cylindrical part (2,). For a mesh, its scale factors (3,).
        position: Position of its center in the body's frame, shape (3,), in m.
        rotation: Rotation matrix of its axes there, shape (3, 3).
        body: Name of the link or object.
        friction: Coefficient of friction.
        restitution: Coefficient of restitution.
        mesh: File of a mesh.
        torsional_friction: Friction torque about the normal of a contact per normal force, in m.
        rolling_friction: Friction torque against rolling per normal force, in m.
    """

    kind: str
    size: tuple[float, ...]
    position: Vector
    rotation: Vector
    body: str
    friction: float
    restitution: float
    mesh: Path | None = None
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0


def material_of(robot: Robot, **file: float) -> dict[str, Any]:
    """Return what a robot's shapes are made of: options of `CollisionShape`.

    Args:
        robot: The robot's description.
        file: Coefficients of friction in its file, by option.
    """
    found = {"friction": 1.0, "torsional_friction": 0.0, "rolling_friction": 0.0, **file}
    given = {option: getattr(robot, option) for option in found}
    found |= {option: value for option, value in given.items() if value is not None}
    return {"restitution": robot.restitution, **found}


def shapes_of_robot(robot: Robot, path: Path, tree: UrdfTree) -> tuple[CollisionShape, ...]:
    """Return the collision shapes of a robot.

    Args:
        robot: Its description.
        path: Its URDF file.
        tree: Its links.
    """
    shapes: list[CollisionShape] = []
    material = material_of(robot)
    for name in tree.elements:
        if name in robot.feet:
            shapes.append(shape_of_foot(robot, name))
        elif robot.collisions != "none":
            for each in tree.shapes(name, "collision"):
                if each.kind != "mesh" and not min(each.size) > 0:
                    raise ModelError(f'link "{name}" has a {each.kind} of size {each.size}')
                pose = each.pose[:3, 3].copy(), each.pose[:3, :3].copy()
                mesh = mesh_path(path, each.mesh, robot.package_dirs) if each.mesh else None
                shape = CollisionShape(each.kind, each.size, *pose, name, mesh=mesh, **material)
                shapes.append(simplified(shape, robot.collisions))
    return tuple(shapes)


def shape_of_foot(robot: Robot, link: str) -> CollisionShape:
    """Return the sphere that a robot has in the place of a link's own shapes."""
    size, material = (float(robot.feet[link]),), material_of(robot)
    return CollisionShape("sphere", size, np.zeros(3), np.eye(3), link, **material)


def shape_of_object(thing: WorldObject) -> CollisionShape:
    """Return the shape of an object."""
    mesh = None
    if isinstance(thing, Box):
        kind, size = "box", thing.size
    elif isinstance(thing, Sphere):
        kind, size = "sphere", (float(thing.radius),)
    elif isinstance(thing, (Capsule, Cylinder)):
        kind = type(thing).__name__.lower()
        size = (float(thing.radius), float(thing.length))
    elif isinstance(thing, Mesh):
        kind, size, mesh = "mesh", (float(thing.scale),) * 3, Path(thing.path).absolute()
        read_vertices(mesh, size)
    else:
        raise ModelError(
            f'Object "{thing.name}" is a {type(thing).__name__}, which is not a shape.'
        )
    return CollisionShape(kind, size, np.zeros(3), np.eye(3), thing.name, mesh=mesh, **_own(thing))


def steps_of(stairs: Stairs) -> list[CollisionShape]:
    """Return the boxes of which stairs consist, where they are in the world."""
    return [
        CollisionShape("box", size, np.array(center), np.eye(3), "ground", **_own(stairs))
        for center, size in stairs.boxes()
    ]


def _own(thing: WorldObject | Stairs) -> dict[str, Any]:
    return {option: getattr(thing, option) for option in MATERIAL}


def moments(shape: CollisionShape, mass: float) -> Vector:
    """Return the principal moments of inertia of a solid body, shape (3,), in kg m²."""
    try:
        found = _moments(shape, mass)
    except (OverflowError, ZeroDivisionError):
        found = np.full(3, math.inf)
    if not ((found > 0) & np.isfinite(found)).all():
        raise ModelError(
            f'Object "{shape.body}" of {mass} kg has the size {shape.size} in m: its moments of '
            "inertia cannot be represented as numbers."
        )
    return found


def _moments(shape: CollisionShape, mass: float) -> Vector:
    if shape.kind == "sphere":
        return np.full(3, 0.4 * mass * shape.size[0] ** 2)
    if shape.kind in ("capsule", "cylinder"):
        return np.array(_round_moments(shape, mass))
    if shape.mesh is not None:
        size = bounding_box(read_vertices(shape.mesh, shape.size))[1]
    else:
        size = np.array(shape.size)
    squares = size**2
    found: Vector = mass / 12 * (squares.sum() - squares)
    return found


def _round_moments(shape: CollisionShape, mass: float) -> tuple[float, float, float]:
    r, length = shape.size
    body, ends = math.pi * r**2 * length, 4 / 3 * math.pi * r**3
    if shape.kind == "cylinder":
        ends = 0.0
    cylinder, sphere = mass * body / (body + ends), mass * ends / (body + ends)
    across = cylinder * (length**2 / 12 + r**2 / 4)
    across += sphere * (0.4 * r**2 + length**2 / 4 + 3 / 8 * length * r)
    return across, across, cylinder * r**2 / 2 + sphere * 0.4 * r**2


def simplified(shape: CollisionShape, collisions: str) -> CollisionShape:
    """Return the bounding box or capsule of a mesh if requested, else the shape itself."""
    if shape.mesh is None:
        return shape
    vertices = read_vertices(shape.mesh, shape.size)
    if collisions == "boxes":
        center, size = bounding_box(vertices)
        kind, axes = "box", np.eye(3)
    elif collisions == "capsules":
        center, axes, size = bounding_capsule(vertices)
        kind = "capsule" if size[1] > 0 else "sphere"
        size = size if size[1] > 0 else size[:1]
    else:
        return shape
    return replace(
        shape,
        kind=kind,
        size=tuple(float(length) for length in size),
        position=shape.position + shape.rotation @ center,
        rotation=shape.rotation @ axes,
        mesh=None,
    )
