"""Creation of DART skeletons for robots, objects, and the ground, with their shapes."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from dartpy import dynamics, utils

from physx_core.rotations import to_matrix, to_rotation_vector
from physx_core.typing import Vector
from physx_sim import Ground, HeightField, Stairs
from physx_sim.engines import (
    CollisionShape,
    Joint,
    LoadedBody,
    LoadedRobot,
    MovableBody,
    RigidBody,
    Static,
    check_loaded,
    geometry_file,
)
from physx_sim.errors import ModelError

GROUND_SIZE = (1000.0, 1000.0, 10.0)
"""Size of the box that represents an infinite plane, in m. For a box on a plane, DART finds a
single contact point; for a box on a box, all corners."""

_ACTUATORS = {
    "force": dynamics.ActuatorType.FORCE,
    "servo": dynamics.ActuatorType.SERVO,
    "velocity": dynamics.ActuatorType.VELOCITY,
    "position": dynamics.ActuatorType.SERVO,
}
_LIMITS: Mapping[str, Callable[[Any], float]] = {
    "lower": lambda joint: joint.getPositionLowerLimit(0),
    "upper": lambda joint: joint.getPositionUpperLimit(0),
    "max_velocity": lambda joint: joint.getVelocityUpperLimit(0),
    "max_torque": lambda joint: joint.getForceUpperLimit(0),
    "damping": lambda joint: joint.getDampingCoefficient(0),
    "friction": lambda joint: joint.getCoulombFriction(0),
}
"""How to read an attribute of `Joint` from DART's joint."""

_MESH = (
    '<robot name="mesh"><link name="mesh"><collision><geometry><mesh filename="{}"/>'
    "</geometry></collision></link></robot>"
)


def load_skeleton(movable: MovableBody, *, free: bool = False) -> dynamics.Skeleton:
    """Return the skeleton of a robot or object, without shapes.

    Args:
        movable: The robot or object.
        free: Whether its joints have neither limits nor resistance, and take torques.

    Raises:
        ModelError: If DART holds something else than physx read.
    """
    model = movable.model
    skeleton = dynamics.Skeleton(movable.name)
    nodes: list[Any] = []
    for link in model.bodies:
        nodes.append(_add_link(skeleton, link, nodes, movable))
    write_masses(skeleton, movable)
    moving = [
        node.getParentJoint()
        for link, node in zip(model.bodies, nodes, strict=True)
        if link.joint is not None
    ]
    limits: dict[str, Vector] = {}
    if not free:
        for joint, native in zip(model.joints, moving, strict=True):
            _configure(joint, native)
        for name, read in _LIMITS.items():
            limits[name] = np.array([read(native) for native in moving], np.float64)
    axes = np.array([joint.getAxis() for joint in moving]).reshape(-1, 3)
    poses = [node.getParentJoint().getTransformFromParentBodyNode().matrix() for node in nodes]
    found = [LoadedBody((place,), *_inertia(node)) for place, node in enumerate(nodes)]
    check_loaded("dart", movable, LoadedRobot(np.array(poses), axes, found, limits))
    return skeleton


def _add_link(
    skeleton: dynamics.Skeleton, link: RigidBody, nodes: Sequence[Any], movable: MovableBody
) -> Any:
    """Add a link and the joint that leads to it; return its body."""
    parent, place = (nodes[link.parent], link.pose) if nodes else (None, None)
    if link.joint is not None:
        revolute = link.joint.unit == "rad"
        joint, body = (
            skeleton.createRevoluteJointAndBodyNodePair(parent)
            if revolute
            else skeleton.createPrismaticJointAndBodyNodePair(parent)
        )
        joint.setAxis(link.axis)
    elif nodes or movable.fixed_base:
        joint, body = skeleton.createWeldJointAndBodyNodePair(parent)
        if not nodes:
            place = _transform(movable.position, to_matrix(movable.orientation))
    else:
        joint, body = skeleton.createFreeJointAndBodyNodePair()
    if place is not None:
        joint.setTransformFromParentBodyNode(place)
    return body


def _inertia(node: Any) -> tuple[float, Vector, Vector]:
    held = node.getInertia()
    return held.getMass(), held.getLocalCOM(), held.getMoment()


def _configure(joint: Joint, native: Any) -> None:
    """Set the limits, resistance, and actuator of a joint in DART."""
    native.setPositionLowerLimit(0, joint.lower)
    native.setPositionUpperLimit(0, joint.upper)
    native.setVelocityLowerLimit(0, -joint.max_velocity)
    native.setVelocityUpperLimit(0, joint.max_velocity)
    native.setForceLowerLimit(0, -joint.max_torque)
    native.setForceUpperLimit(0, joint.max_torque)
    native.setLimitEnforcement(True)
    native.setDampingCoefficient(0, joint.damping)
    native.setCoulombFriction(0, joint.friction)
    native.setSpringStiffness(0, joint.stiffness)
    native.setRestPosition(0, joint.rest)
    native.setActuatorType(_ACTUATORS[joint.mode])


def attach_shapes(skeleton: dynamics.Skeleton, movable: MovableBody) -> None:
    """Attach the collision shapes of a robot or object to its bodies."""
    for shape in movable.model.shapes:
        body = skeleton.getBodyNode(_link_of(shape, movable.model.links))
        _attach(body, _dart_shape(shape), shape, _transform(shape.position, shape.rotation))


def write_masses(skeleton: dynamics.Skeleton, movable: MovableBody) -> None:
    """Write the masses and moments of inertia of a robot's or object's links."""
    with _silence():  # DART warns of links without mass
        for link, body in zip(movable.model.bodies, skeleton.getBodyNodes(), strict=True):
            body.setInertia(dynamics.Inertia(link.mass, link.center, link.inertia))


def static_skeleton(static: Static) -> dynamics.Skeleton:
    """Return the skeleton of a static shape or the ground, which moves only as prescribed."""
    skeleton = dynamics.Skeleton(static.name)
    joint, body = skeleton.createFreeJointAndBodyNodePair()
    joint.setActuatorType(dynamics.ActuatorType.VELOCITY)
    place_skeleton(skeleton, np.array([*static.position, *static.orientation]), np.zeros(6))
    attach_static(body, static)
    return skeleton


def place_skeleton(skeleton: dynamics.Skeleton, pose: Vector, velocity: Vector) -> None:
    """Place a static skeleton for the next step.

    Args:
        skeleton: The skeleton.
        pose: Position in m and quaternion x, y, z, w, shape (7,).
        velocity: Linear and angular velocity in the world frame, in m/s and rad/s, shape (6,).
    """
    moves = bool(velocity.any())
    skeleton.setMobile(moves)
    joint, place = skeleton.getJoint(0), _transform(pose[:3], to_matrix(pose[3:]))
    # A body that does not move is placed by its joint, to the last digit.
    joint.setTransformFromParentBodyNode(np.eye(4) if moves else place)
    turn = to_rotation_vector(pose[3:])
    skeleton.setPositions(np.concatenate([turn, pose[:3]]) if moves else np.zeros(6))
    skeleton.setVelocities(velocity[[3, 4, 5, 0, 1, 2]])
    skeleton.setCommands(velocity[[3, 4, 5, 0, 1, 2]])


def attach_static(body: dynamics.BodyNode, static: Static) -> None:
    """Attach the shapes of a static body, instead of those that it has."""
    body.removeAllShapeNodes()
    what = static.what
    if isinstance(what, CollisionShape):
        _attach(body, _dart_shape(what), what, _transform(what.position, what.rotation))
    elif isinstance(what, HeightField):
        _attach(body, _height_shape(what), what, np.eye(4))
    else:
        for size, place in _ground_boxes(what):
            _attach(body, dynamics.BoxShape(list(size)), what, place)


def _ground_boxes(ground: Ground | Stairs) -> list[tuple[Sequence[float], Vector]]:
    normal = np.array(ground.normal if isinstance(ground, Ground) else (0.0, 0.0, 1.0))
    height = ground.height if isinstance(ground, Ground) else 0.0
    center = (height - 0.5 * GROUND_SIZE[2]) * normal
    boxes: list[tuple[Sequence[float], Vector]] = [
        (GROUND_SIZE, _transform(center, _axes_along(normal)))
    ]
    if isinstance(ground, Stairs):
        boxes += [(size, _transform(place, np.eye(3))) for place, size in ground.boxes()]
    return boxes


def _axes_along(normal: Vector) -> Vector:
    """Return a rotation matrix whose last column is a given direction."""
    if normal[2] > 1 - 1e-15:
        return np.eye(3)
    other = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = np.cross(other, normal)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(normal, first), normal])


def _attach(
    body: dynamics.BodyNode,
    shape: object,
    material: CollisionShape | Ground | Stairs | HeightField,
    place: Vector,
) -> None:
    node = body.createShapeNode(shape)
    node.setRelativeTransform(place)
    node.createCollisionAspect()
    aspect = node.createDynamicsAspect()
    aspect.setFrictionCoeff(float(material.friction))
    aspect.setRestitutionCoeff(float(material.restitution))


def write_frictions(skeleton: dynamics.Skeleton, movable: MovableBody) -> None:
    """Write the coefficients of friction of a robot's or object's shapes."""
    nodes = [node for body in skeleton.getBodyNodes() for node in body.getShapeNodes()]
    links = list(movable.model.links)
    shapes = sorted(movable.model.shapes, key=lambda each: _link_of(each, links))
    for node, shape in zip(nodes, shapes, strict=True):
        node.getDynamicsAspect().setFrictionCoeff(float(shape.friction))


def _link_of(shape: CollisionShape, links: Sequence[str]) -> int:
    """Return the index of the link that has a shape; an object has a single link."""
    return links.index(shape.body) if shape.body in links else 0


def _dart_shape(shape: CollisionShape) -> Any:
    size = list(shape.size)
    if shape.mesh is not None:
        with geometry_file(shape.mesh) as bare:
            loaded = _load_mesh(bare)
        loaded.setScale(size)
        return loaded
    if shape.kind == "box":
        return dynamics.BoxShape(size)
    if shape.kind == "sphere":
        return dynamics.SphereShape(*size)
    if shape.kind == "capsule":
        return dynamics.CapsuleShape(*size)
    return dynamics.CylinderShape(*size)


def _load_mesh(path: Path) -> Any:
    text = _MESH.format(str(path).replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;"))
    with _silence() as messages:
        skeleton = utils.DartLoader().parseSkeletonString(text, "")
    for node in () if skeleton is None else skeleton.getBodyNode(0).getShapeNodes():
        return node.getShape()
    raise ModelError(f"DART finds no mesh in {path}.{''.join(messages)}")


def _height_shape(field: HeightField) -> Any:
    """Return a height field's mesh, via a file, because DART only loads meshes from files."""
    nx, ny = field.heights.shape
    x0, y0 = field.corner()
    lines = [
        f"v {x0 + i * field.spacing[0]!r} {y0 + j * field.spacing[1]!r} {float(z)!r}"
        for (i, j), z in np.ndenumerate(field.heights)
    ]
    for i in range(nx - 1):
        for j in range(ny - 1):
            a, b = i * ny + j + 1, (i + 1) * ny + j + 1
            lines += [f"f {a} {b} {b + 1}", f"f {a} {b + 1} {a + 1}"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "heights.obj"
        path.write_text("\n".join(lines) + "\n", encoding="ascii")
        return _load_mesh(path)


def _transform(position: Sequence[float] | Vector, rotation: Vector) -> Vector:
    transform = np.zeros((4, 4))
    transform[:3, :3], transform[:3, 3], transform[3, 3] = rotation, position, 1.0
    return transform


@contextmanager
def _silence() -> Iterator[list[str]]:
    """Collect what native code in this process writes to standard error."""
    messages: list[str] = []
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield messages
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            file.seek(0)
            messages.append(" Its output: " + file.read().decode(errors="replace").strip())
