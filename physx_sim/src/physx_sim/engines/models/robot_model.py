"""Robot models: what engines load, and the options of a robot that apply to any file."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from physx_core.errors import listed, nearest
from physx_core.typing import Vector
from physx_sim import Attachment, JointCoupling, Mimic, Robot, Wheel
from physx_sim.engines.models.rigid_bodies import Inertial, Joint, RigidBody
from physx_sim.engines.models.shapes import CollisionShape
from physx_sim.errors import ModelError

_MOST = 1000
"""Maximum number of projections onto what couplings and limits allow."""
_CLOSE, _ROUNDED = 1e-9, 1e-3
"""Distance from limits, in rad or m, at which projections end, and above which couplings contradict
them: the numbers in files are rounded."""


@dataclass(frozen=True)
class RobotModel:
    """The model of a robot.

    Attributes:
        path: Absolute path of the file.
        bodies: The links, parents before children, in tree order.
        shapes: Collision shapes; empty if there is nothing to touch.
        attachments: What holds its links together besides its joints, by their names in the file.
        couplings: Which joints move together, besides those that follow others.
        wheels: Links that roll without slip; their shapes have no friction.
        warnings: What is wrong with the file, although it can be simulated, and what of it no
            engine is told.
    """

    path: Path
    bodies: tuple[RigidBody, ...]
    shapes: tuple[CollisionShape, ...] = ()
    warnings: tuple[str, ...] = ()
    attachments: tuple[Attachment, ...] = ()
    couplings: tuple[JointCoupling, ...] = ()
    wheels: tuple[Wheel, ...] = ()

    @functools.cached_property
    def links(self) -> tuple[str, ...]:
        """Names of all links, in the order of `bodies`."""
        return tuple(body.name for body in self.bodies)

    @functools.cached_property
    def joints(self) -> tuple[Joint, ...]:
        """The joints with one degree of freedom, in the order of `bodies`."""
        return tuple(body.joint for body in self.bodies if body.joint is not None)

    @functools.cached_property
    def followers(self) -> tuple[tuple[int, int, Mimic], ...]:
        """Joints that follow others: place of the joint in `joints`, place of its leader, how."""
        places = {joint.name: place for place, joint in enumerate(self.joints)}
        return tuple(
            (place, places[joint.mimic.leader], joint.mimic)
            for place, joint in enumerate(self.joints)
            if joint.mimic is not None
        )

    @functools.cached_property
    def coupling_rows(self) -> tuple[Vector, Vector]:
        """Coefficients of positions of joints, (m, joints), and sums that they always have, (m,).

        Joints that follow others come first. The largest coefficient of a coupling is 1 or -1.
        """
        places = {joint.name: place for place, joint in enumerate(self.joints)}
        sums = [mimic.offset for *_, mimic in self.followers]
        rows = np.zeros((len(self.followers) + len(self.couplings), len(places)))
        for row, (follower, leader, mimic) in zip(rows, self.followers, strict=False):
            row[follower], row[leader] = 1.0, -mimic.multiplier
        for row, coupling in zip(rows[len(sums) :], self.couplings, strict=True):
            scale = 1 / max(map(abs, coupling.joints.values()))
            for name, coefficient in coupling.joints.items():
                row[places[name]] = scale * coefficient
            sums.append(scale * coupling.offset)
        return rows, np.array(sums)

    @functools.cached_property
    def start(self) -> Vector:
        """Positions of the joints at the start, shape (joints,): 0 or the nearest limit.

        Joints that follow others or are coupled are where these let them be.
        """
        return self.allowed(np.array([max(j.lower, min(0.0, j.upper)) for j in self.joints]))

    def allowed(self, positions: Vector) -> Vector:
        """Return positions of joints, shape (joints,), where couplings and leaders let them be.

        Followers are moved to where their leaders are; if there are couplings, all joints to the
        nearest positions within their limits.

        Args:
            positions: Within the joints' limits, shape (joints,), in rad or m.
        """
        found = np.array(positions, np.float64)
        for follower, leader, mimic in self.followers:
            found[follower] = mimic.multiplier * found[leader] + mimic.offset
        if not self.couplings:
            return found
        lower, upper = np.array([(joint.lower, joint.upper) for joint in self.joints]).T
        rows, sums = self.coupling_rows
        inverse, beyond = np.linalg.pinv(rows), np.zeros(len(found))
        for _ in range(_MOST):  # Dykstra's projections, one after the other
            coupled = found - inverse @ (rows @ found - sums)
            found = np.clip(coupled + beyond, lower, upper)
            beyond += coupled - found
            if np.abs(found - coupled).max() < _CLOSE:
                break
        return coupled


def model_of_body(name: str, path: Path, inertial: Inertial, shape: CollisionShape) -> RobotModel:
    """Return the model of an object: a robot with one link.

    Args:
        name: Name of the link.
        path: Name of the object, as a path.
        inertial: The link's inertia.
        shape: Its collision shape.
    """
    body = RigidBody(name, -1, np.eye(4), None, np.zeros(3), *inertial.in_link())
    return RobotModel(path, (body,), (shape,))


def coupled(
    robot: Robot,
    model: RobotModel,
    mimics: Mapping[str, Mimic],
    couplings: Sequence[JointCoupling] = (),
) -> RobotModel:
    """Return a model whose joints move together.

    Args:
        robot: The robot's description, whose settings come before the file's.
        model: Its model.
        mimics: How joints follow others in the file, by name.
        couplings: Couplings of joints in the file.

    Raises:
        ModelError: If a joint does not exist, a leader follows its follower, a follower has
            commands, or couplings repeat or contradict each other or the limits of their joints,
            or leave no motion to a motor.
    """
    model = _with_leaders(robot, model, mimics)
    names = [joint.name for joint in model.joints]
    chosen = tuple(couplings if robot.couplings is None else robot.couplings)
    for name in (name for coupling in chosen for name in coupling.joints):
        if name not in names:
            near = nearest(name, names)
            raise ModelError(f'a coupling names "{name}", which is not a movable joint.{near}')
    if chosen:
        model = replace(model, couplings=chosen)
        _check_independent(model)
    return model


def with_wheels(robot: Robot, model: RobotModel) -> RobotModel:
    """Return a model with the wheels of a robot's description.

    Args:
        robot: The robot's description.
        model: Its model.

    Raises:
        ModelError: If a link is named twice.
    """
    links = [wheel.link for wheel in robot.wheels]
    if len(set(links)) < len(links):
        raise ModelError(f"its wheels need different links, but are {listed(links)}")
    shapes = tuple(
        replace(shape, friction=0.0) if shape.body in links else shape for shape in model.shapes
    )
    return replace(model, shapes=shapes, wheels=tuple(robot.wheels))


def _check_independent(model: RobotModel) -> None:
    """Check that all couplings can hold at the same time, whatever their motors do."""
    rows = model.coupling_rows[0]
    yields = [
        joint.mode == "force" or (joint.mode != "velocity" and joint.max_torque < np.inf)
        for joint in model.joints
    ]
    for what, some in (
        ("repeat or contradict each other", rows),
        ("hold joints whose motors impose their velocities", rows[:, yields]),
    ):
        if np.linalg.matrix_rank(some) < len(rows):
            raise _contradicts(what)
    for joint, position in zip(model.joints, model.start.tolist(), strict=True):
        if not joint.lower - _ROUNDED <= position <= joint.upper + _ROUNDED:
            raise _contradicts(f'allow no positions within the limits of "{joint.name}"')


def _contradicts(what: str) -> ModelError:
    return ModelError(f"its couplings {what}; Robot(couplings=...) replaces those of its file")


def _with_leaders(robot: Robot, model: RobotModel, file: Mapping[str, Mimic]) -> RobotModel:
    """Return a model whose joints follow others; `file`: how they do in the file, by name."""
    names = [joint.name for joint in model.joints]
    given = {name: each.mimic for name, each in robot.joints.items() if each.mimic is not None}
    follows = {name: mimic for name, mimic in {**file, **given}.items() if mimic.leader}
    if not follows:
        return model
    for name, mimic in follows.items():
        if mimic.leader not in names:
            near = nearest(mimic.leader, names)
            raise ModelError(
                f'joint "{name}" follows "{mimic.leader}", which is not a movable joint.{near}'
            )
    found = {name: _through(name, follows) for name in follows}
    bodies = list(model.bodies)
    for place, body in enumerate(bodies):
        joint = body.joint
        if joint is not None and joint.name in found:
            if joint.mode != "force":
                raise ModelError(
                    f'joint "{joint.name}" follows "{found[joint.name].leader}", so it takes no '
                    f'commands of the mode "{joint.mode}"; Mimic("") lets it move freely'
                )
            joint = replace(joint, mimic=found[joint.name], max_torque=0.0)
            bodies[place] = replace(body, joint=joint)
    return replace(model, bodies=tuple(bodies))


def _through(name: str, follows: Mapping[str, Mimic]) -> Mimic:
    """Return how a joint follows the first of a chain of leaders."""
    mimic, passed = follows[name], [name]
    while mimic.leader in follows:
        if mimic.leader in passed:
            raise ModelError(f"joints follow each other in a circle: {listed(passed)}")
        passed.append(mimic.leader)
        above = follows[mimic.leader]
        offset = mimic.multiplier * above.offset + mimic.offset
        mimic = Mimic(above.leader, mimic.multiplier * above.multiplier, offset)
    return mimic


def check_names(robot: Robot, links: Sequence[str], joints: Sequence[str]) -> None:
    """Check that a robot's options name links and joints of its file.

    Args:
        robot: The robot's description.
        links: Names of all links.
        joints: Names of the movable joints.
    """
    for option, given, kind, known in (
        ("joints", robot.joints, "movable joint", joints),
        ("mass_factors", robot.mass_factors, "link", links),
        ("feet", robot.feet, "link", links),
        ("wheels", [wheel.link for wheel in robot.wheels], "link", links),
    ):
        for name in given:
            if name not in known:
                raise ModelError(
                    f'{option} names "{name}", which is not a {kind}.{nearest(name, known)} '
                    f"{kind.rpartition(' ')[2].capitalize()}s: {listed(known)}"
                )
