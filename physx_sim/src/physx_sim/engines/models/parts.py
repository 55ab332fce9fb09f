"""Parts of a world as loaded by engines: movables as robot models, and static bodies."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from physx_sim import (
    Attachment,
    Ground,
    HeightField,
    Layout,
    Part,
    Robot,
    Stairs,
    World,
    WorldObject,
)
from physx_sim.engines.models.reading import read_robot
from physx_sim.engines.models.rigid_bodies import Inertial, Joint
from physx_sim.engines.models.robot_model import RobotModel, model_of_body
from physx_sim.engines.models.shapes import CollisionShape, moments, shape_of_object
from physx_sim.errors import ModelError


@dataclass(frozen=True)
class MovableBody:
    """A robot or moving object.

    Attributes:
        name: Its name in the world.
        model: Its model; an object is a robot with one link named ``body``.
        fixed_base: Whether its root link is welded to the world.
        position: Initial position of the root link, in m.
        orientation: Its initial orientation, quaternion x, y, z, w.
        self_collisions: Whether its links collide with each other.
        is_object: Whether it is an object.
    """

    name: str
    model: RobotModel
    fixed_base: bool
    position: tuple[float, ...]
    orientation: tuple[float, ...]
    self_collisions: bool = False
    is_object: bool = False

    @property
    def moves(self) -> bool:
        """Whether any of its links can move; otherwise it is static, like scenery."""
        return not self.fixed_base or bool(self.model.joints)


@dataclass(frozen=True)
class Static:
    """A static object or the ground.

    Attributes:
        name: Its name in the world.
        what: The shape or the ground.
        position: Position of the shape, in m.
        orientation: Its orientation, quaternion x, y, z, w.
    """

    name: str
    what: CollisionShape | Ground | Stairs | HeightField
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Parts:
    """All parts of a world.

    Attributes:
        world: Its description.
        movables: Robots, then moving objects.
        statics: The ground, then static objects.
        attachments: What holds bodies together, by their names in the layout.
    """

    world: World
    movables: tuple[MovableBody, ...]
    statics: tuple[Static, ...]
    attachments: tuple[Attachment, ...] = ()

    @property
    def turning(self) -> bool:
        """Whether anything has torsional or rolling friction."""
        touching = [shape for movable in self.movables for shape in movable.model.shapes]
        whats = [*touching, *(static.what for static in self.statics)]
        return any(what.torsional_friction or what.rolling_friction for what in whats)

    @property
    def rolling(self) -> bool:
        """Whether anything has wheels that roll without slip."""
        return any(movable.model.wheels for movable in self.movables)


def read_parts(world: World) -> Parts:
    """Read a world's files, and warn once about robots whose inertia is wrong.

    Raises:
        ModelError: If a robot or mesh cannot be loaded, nothing can move, or wheels have no plane
            to roll on.
    """
    movables = [
        _robot(robot, world.ground, _touches(world, robot.self_collisions))
        for robot in world.robots
    ]
    scenery = [movable for movable in movables if not movable.moves]
    if scenery and world.contacts == "static":  # they touch like static objects
        movables = [_robot(robot, world.ground, True) for robot in world.robots]
    for movable in movables:
        for text in movable.model.warnings:
            where = f'Robot "{movable.name}", {movable.model.path}'
            warn_once(f"{where}: {text}.")
    statics = [] if world.ground is None else [Static("ground", world.ground)]
    for thing in world.objects:
        if thing.static:
            shape = shape_of_object(thing)
            statics.append(Static(thing.name, shape, thing.position, thing.orientation))
        else:
            movables.append(_object(thing))
    if not any(movable.moves for movable in movables):
        raise _nothing_moves(scenery[0])
    attachments: list[Attachment] = []
    for movable in movables:
        prefix = _prefix(world, movable)
        attachments += (
            replace(each, body_a=prefix + each.body_a, body_b=prefix + each.body_b)
            for each in movable.model.attachments
        )
    return Parts(world, tuple(movables), tuple(statics), (*attachments, *world.attachments))


def _prefix(world: World, movable: MovableBody) -> str:
    """Return what the names of a robot's links and joints begin with in the layout."""
    return f"{movable.name}/" if len(world.robots) > 1 else ""


def _robot(robot: Robot, ground: object, touching: bool) -> MovableBody:
    model = read_robot(robot, touching=touching)
    pose = robot.position, robot.orientation
    if model.wheels and not isinstance(ground, Ground):
        raise ModelError(
            f'Robot "{robot.name}", {model.path}: its wheels roll without slip on a plane; the '
            "world needs ground=Ground(...)."
        )
    return MovableBody(robot.name, model, robot.fixed_base, *pose, robot.self_collisions)


def warn_once(text: str) -> None:
    """Warn once of a text: simulations of the same file are built many times.

    Args:
        text: What to say, as in `warnings.warn`.
    """
    _warn(text)


@functools.cache
def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=6)


def _nothing_moves(scenery: MovableBody) -> ModelError:
    floats = scenery.model.links[0] != "world"
    return ModelError(
        f'Robot "{scenery.name}", {scenery.model.path}: it has no movable joint and a fixed base, '
        "so it is static, and nothing else in the world can move. "
        f"{'Use fixed_base=False to let it float, or add' if floats else 'Add'} a robot or an "
        "object that moves."
    )


def _touches(world: World, itself: bool) -> bool:
    """Return whether a robot of this world can touch anything, if no robot is static."""
    if world.contacts == "none":
        return False
    static = world.ground is not None or any(thing.static for thing in world.objects)
    moving = len(world.robots) > 1 or itself or bool(world.objects)
    return static or (world.contacts == "all" and moving)


def _object(thing: WorldObject) -> MovableBody:
    shape = shape_of_object(thing)
    xx, yy, zz = moments(shape, thing.mass).tolist()
    inertial = Inertial(float(thing.mass), (xx, yy, zz, 0.0, 0.0, 0.0))
    model = model_of_body("body", Path(thing.name), inertial, shape)
    return MovableBody(thing.name, model, False, thing.position, thing.orientation, is_object=True)


def static_poses(parts: Parts) -> np.ndarray:
    """Return the poses of static bodies, shape (statics, 7)."""
    poses = [[*static.position, *static.orientation] for static in parts.statics]
    found = np.array(poses, np.float64).reshape(-1, 7)
    found[found[:, 6] < 0, 3:] *= -1
    return found


def layout_of(parts: Parts) -> Layout:
    """Return the names and indices of everything in the state."""
    joints: list[Joint] = []
    joint_names: list[str] = []
    bodies: list[str] = []
    position_index: dict[str, int] = {}
    velocity_index: dict[str, int] = {}
    places: dict[str, Part] = {}
    nq = nv = 0
    for movable in parts.movables:
        prefix = _prefix(parts.world, movable)
        begin = nq, nv, len(joint_names), len(bodies)
        nq, nv = nq + (0 if movable.fixed_base else 7), nv + (0 if movable.fixed_base else 6)
        for joint in movable.model.joints:
            joint_names.append(prefix + joint.name)
            position_index[joint_names[-1]], velocity_index[joint_names[-1]] = nq, nv
            nq, nv = nq + 1, nv + 1
        joints += movable.model.joints
        bodies += (
            [movable.name] if movable.is_object else [prefix + name for name in movable.model.links]
        )
        ends = nq, nv, len(joint_names), len(bodies)
        slices = [slice(*pair) for pair in zip(begin, ends, strict=True)]
        places[movable.name] = Part(movable.name, not movable.fixed_base, *slices)
    statics = tuple(static.name for static in parts.statics)
    _check_names([*bodies, *statics])
    return Layout(
        tuple(joint_names),
        tuple(bodies),
        position_index,
        velocity_index,
        nq,
        nv,
        lower=_column(joints, "lower"),
        upper=_column(joints, "upper"),
        max_velocity=_column(joints, "max_velocity"),
        max_torque=_column(joints, "max_torque"),
        parts=places,
        statics=statics,
        modes=tuple(joint.mode for joint in joints),
        units=tuple(joint.unit for joint in joints),
    )


def _column(joints: Sequence[Joint], name: str) -> np.ndarray:
    return np.array([getattr(joint, name) for joint in joints], np.float64)


def _check_names(names: Sequence[str]) -> None:
    if len(set(names)) == len(names):
        return
    name = next(name for name in names if names.count(name) > 1)
    raise ModelError(
        f'A link and an object or the ground share the name "{name}". Give the object another one.'
    )
