"""Pinocchio's models of robots and objects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio

from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim.engines import LoadedBody, LoadedRobot, MovableBody, check_loaded
from physx_sim.errors import ModelError

_MOST_VELOCITIES = 192


def load_model(movable: MovableBody, gravity: tuple[float, ...], *, armature: Vector) -> Any:
    """Return the model of a robot or object in the convention of `physx_core`."""
    return _load(movable, gravity, armature, pinocchio.JointModelFreeFlyer())


def load_stepping_model(
    movable: MovableBody, gravity: tuple[float, ...], *, armature: Vector
) -> Any:
    """Return the model for stepping, whose base translates along the world's axes.

    Its positions are those of `load_model`. The first three velocities of a floating base are in
    the world frame, not its own, so that semi-implicit Euler conserves the linear momentum of a
    tumbling body, as in DART; in the base's own frame it would not.
    """
    base = pinocchio.JointModelTranslation(), pinocchio.JointModelSpherical()
    return _load(movable, gravity, armature, *base)


def frames_of(movable: MovableBody) -> list[int]:
    """Return the frame of each link in a model; frame 0 is the world."""
    return list(range(1, len(movable.model.links) + 1))


def twists_of(found: Vector) -> Vector:
    """Return a Jacobian of Pinocchio, which returns a single column as a vector, shape (6, nv)."""
    return found.reshape(6, -1)


def write_inertias(movable: MovableBody, model: Any) -> None:
    """Write the inertias of a robot's or object's links into its model."""
    found = [pinocchio.Inertia.Zero() for _ in range(model.njoints)]
    for link, number in zip(movable.model.bodies, frames_of(movable), strict=True):
        frame = model.frames[number]
        inertia = pinocchio.Inertia.Zero()  # its constructor refuses what only a whole body needs
        inertia.mass, inertia.lever, inertia.inertia = link.mass, link.center, link.inertia
        found[frame.parentJoint] += frame.placement.act(inertia)
    for joint, inertia in enumerate(found):
        model.inertias[joint] = inertia


def _load(movable: MovableBody, gravity: tuple[float, ...], armature: Vector, *base: Any) -> Any:
    _check_size(movable)
    model, nowhere = pinocchio.Model(), pinocchio.SE3.Identity()
    places: list[tuple[int, Any]] = []  # of each link: its joint, and where it is on it
    for link in movable.model.bodies:
        if link.parent >= 0:
            joint, place = places[link.parent]
            place = place * pinocchio.SE3(link.pose)
        elif movable.fixed_base:
            turn = to_matrix(movable.orientation)
            joint, place = 0, pinocchio.SE3(turn, np.array(movable.position))
        else:
            joint, place = 0, nowhere
            for number, kind in enumerate(base):
                joint = model.addJoint(joint, kind, nowhere, f"physx base {number}")
        if link.joint is not None:
            kind = _joint_model(link.joint.unit, link.axis)
            joint, place = model.addJoint(joint, kind, place, link.joint.name), nowhere
        model.addFrame(pinocchio.Frame(link.name, joint, place, pinocchio.FrameType.BODY))
        places.append((joint, place))
    write_inertias(movable, model)
    model.gravity.linear = np.array(gravity, np.float64)
    model.armature = np.asarray(armature, np.float64)
    check_loaded("pinocchio", movable, _loaded(model, movable))
    return model


def _check_size(movable: MovableBody) -> None:
    velocities = len(movable.model.joints) + (0 if movable.fixed_base else 6)
    if velocities > _MOST_VELOCITIES:
        raise ModelError(
            f"{movable.model.path} has {velocities} degrees of freedom. Pinocchio's memory grows "
            f"with their cube, so at most {_MOST_VELOCITIES} are allowed; use the engine dart."
        )


def _joint_model(unit: str, axis: Vector) -> Any:
    """Return a joint about or along an axis; those of a coordinate axis are faster."""
    kind = "Revolute" if unit == "rad" else "Prismatic"
    if axis.max() == 1.0 and np.count_nonzero(axis) == 1:
        return getattr(pinocchio, f"JointModel{kind[0]}{'XYZ'[int(np.argmax(axis))]}")()
    return getattr(pinocchio, f"JointModel{kind}Unaligned")(axis)


def _loaded(model: Any, movable: MovableBody) -> LoadedRobot:
    """Return what Pinocchio holds of a robot or object, whose limits it does not use."""
    bodies = movable.model.bodies
    frames = [model.frames[frame] for frame in frames_of(movable)]
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
