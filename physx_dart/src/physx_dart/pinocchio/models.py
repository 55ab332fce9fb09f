"""Pinocchio's models of robots and objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio

from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim.engines import LoadedBody, LoadedRobot, MovableBody, check_loaded
from physx_sim.errors import ModelError

_TRANSLATION, _ROTATION = "physx translation", "physx rotation"
_LINK = "physx link "
_MOST_VELOCITIES = 192


def load_model(movable: MovableBody, gravity: tuple[float, ...], *, armature: Vector) -> Any:
    """Return the model of a robot or object in the convention of `physx_core`."""
    if movable.fixed_base:
        model = _parse(movable)
        _weld(model, movable)
    else:
        model = _parse(movable, pinocchio.JointModelFreeFlyer())
    return _finish(model, movable, gravity, armature, 1 if movable.fixed_base else 2)


def load_stepping_model(
    movable: MovableBody, gravity: tuple[float, ...], *, armature: Vector
) -> Any:
    """Return the model for stepping, whose base translates along the world's axes.

    Its positions are those of `load_model`. The first three velocities of a floating base are in
    the world frame, not its own, so that semi-implicit Euler conserves the linear momentum of a
    tumbling body, as in DART; in the base's own frame it would not.
    """
    if movable.fixed_base:
        return load_model(movable, gravity, armature=armature)
    nowhere = pinocchio.SE3.Identity()
    base = pinocchio.Model()
    first = base.addJoint(0, pinocchio.JointModelTranslation(), nowhere, _TRANSLATION)
    second = base.addJoint(first, pinocchio.JointModelSpherical(), nowhere, _ROTATION)
    frame = pinocchio.Frame(_ROTATION, second, 0, nowhere, pinocchio.FrameType.BODY)
    place = base.addFrame(frame)
    robot = _parse(movable)
    links = [frame for frame in robot.frames if frame.type == pinocchio.FrameType.BODY]
    for frame in links:  # appendModel confuses a link and a joint with the same name
        frame.name = f"{_LINK}{frame.name}"
    model = pinocchio.appendModel(base, robot, place, nowhere)
    for frame in model.frames:
        frame.name = frame.name.removeprefix(_LINK)
    return _finish(model, movable, gravity, armature, 3)


def frames_of(model: Any, movable: MovableBody) -> list[int]:
    """Return the frame of each link of a model."""
    return [model.getFrameId(link, pinocchio.FrameType.BODY) for link in movable.model.links]


def twists_of(found: Vector) -> Vector:
    """Return a Jacobian of Pinocchio, which returns a single column as a vector, shape (6, nv)."""
    return found.reshape(6, -1)


def _parse(movable: MovableBody, *root: Any) -> Any:
    try:
        model = pinocchio.buildModelFromXML(movable.model.text, *root)
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"Pinocchio cannot load {movable.model.path}: {error}") from error
    if model.nv > _MOST_VELOCITIES:
        raise ModelError(
            f"{movable.model.path} has {model.nv} degrees of freedom. Pinocchio's memory grows "
            f"with their cube, so at most {_MOST_VELOCITIES} are allowed; use the engine dart."
        )
    return model


def _weld(model: Any, movable: MovableBody) -> None:
    """Place the root of a fixed-base robot."""
    rotation = to_matrix(movable.orientation)
    base = pinocchio.SE3(rotation, np.array(movable.position))
    for joint in range(1, model.njoints):
        if model.parents[joint] == 0:
            model.jointPlacements[joint] = base * model.jointPlacements[joint]
    for place, frame in enumerate(model.frames):
        if frame.parentJoint == 0 and place > 0:
            model.frames[place].placement = base * frame.placement


def _finish(
    model: Any, movable: MovableBody, gravity: tuple[float, ...], armature: Vector, first: int
) -> Any:
    model.gravity.linear = np.array(gravity, np.float64)
    model.armature = np.asarray(armature, np.float64)
    moving = list(model.names)[first:]
    if moving != [joint.name for joint in movable.model.joints]:
        path = movable.model.path
        raise ModelError(f"Pinocchio reads the joints of {path} in a different order: {moving}.")
    check_loaded("pinocchio", movable, _loaded(model, movable))
    return model


def _loaded(model: Any, movable: MovableBody) -> LoadedRobot:
    """Return what Pinocchio holds of a robot or object, whose limits it does not use."""
    bodies = movable.model.bodies
    frames = [model.frames[frame] for frame in frames_of(model, movable)]
    poses, axes = [], []
    for frame, body in zip(frames, bodies, strict=True):
        joint, place = frame.parentJoint, frame.placement
        if body.joint is not None:
            place = model.jointPlacements[joint] * place
            twist = model.joints[joint].createData().S
            axes.append(twist[:3] if body.joint.unit == "m" else twist[3:])
        if body.parent >= 0:
            place = frames[body.parent].placement.actInv(place)
        poses.append(place.homogeneous)
    carried: dict[int, list[int]] = {}
    for link, frame in enumerate(frames):
        carried.setdefault(frame.parentJoint, []).append(link)
    carried.pop(0, None)  # welded to the world
    found = []
    for joint, links in carried.items():
        inertia = frames[links[0]].placement.actInv(model.inertias[joint])
        found.append(LoadedBody(links, inertia.mass, inertia.lever, inertia.inertia))
    return LoadedRobot(np.array(poses), np.array(axes).reshape(-1, 3), found)
