"""Torques of a robot along a path: linear in its unknowns, by Pinocchio."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio

from physx_core.errors import ComponentNotFoundError
from physx_core.typing import Vector
from physx_dart.pinocchio.models import frames_of, load_model
from physx_identify.errors import IdentificationError
from physx_identify.estimation.inertia import TEN, UNITS, carried, ten_of
from physx_identify.unknowns import LINKS, Parameter, Unknown
from physx_sim import Robot, World
from physx_sim.engines import MovableBody, read_parts

_TORQUE = {"rad": "N m", "m": "N"}
GRAVITY = (0.0, 0.0, -9.81)
"""In m/s²."""
STRIBECK = 0.1
"""Velocity at which Stribeck friction has fallen to 1/e, in rad/s or m/s."""


@dataclass(frozen=True)
class Path:
    """A motion in discrete time, sampled at physics steps as the engines step them.

    Attributes:
        positions: Before, at and after each sample, shape (samples + 2, joints), in rad or m.
        period: In s.
        instant: Whether torques are those at the instants of the samples, instead of held from each
            sample to the next.
    """

    positions: Vector
    period: float
    instant: bool = False

    @property
    def own(self) -> Vector:
        """Positions, shape (samples, joints)."""
        return self.positions[1:-1]

    @property
    def velocities(self) -> Vector:
        """Velocities that centrifugal torques depend on, shape (samples, joints)."""
        if self.instant:
            return (self.positions[2:] - self.positions[:-2]) / (2 * self.period)
        return (self.positions[1:-1] - self.positions[:-2]) / self.period

    @property
    def ends(self) -> Vector:
        """Velocities that resistance depends on: of an engine, those at the end of the step."""
        return (
            self.velocities if self.instant else np.diff(self.positions[1:], axis=0) / self.period
        )

    @property
    def accelerations(self) -> Vector:
        """Shape (samples, joints)."""
        return np.diff(self.positions, 2, axis=0) / self.period**2


class Model:
    """A robot on a fixed base, as numbers that its torques are linear in.

    The numbers are the ten of each moving body, then damping, friction, Stribeck friction and
    armature of each joint.

    Attributes:
        robot: The robot.
        movable: The robot as read from its file.
        joints: Names of its joints.
        numbers: All numbers as in its file and settings, shape (14 * joints,).
    """

    def __init__(
        self,
        robot: Robot,
        gravity: Sequence[float] = GRAVITY,
        held: Sequence[str] = (),
    ) -> None:
        """Load a robot.

        Args:
            robot: The robot.
            gravity: In m/s².
            held: Names of joints that do not move: they stay at 0, and are none of the joints.

        Raises:
            ModelError: If it cannot be loaded.
            ComponentNotFoundError: If there is no joint of a name.
            IdentificationError: If its base floats, it has no joints, or joints follow others, are
                coupled, or have springs.
        """
        self.robot = robot
        world = World(robots=[robot], gravity=tuple(gravity))
        self.movable = _with_held(read_parts(world).movables[0], held)
        joints = self.movable.model.joints
        self._check(robot, self.movable)
        self.joints = tuple(joint.name for joint in joints)
        self.units = tuple(joint.unit for joint in joints)
        self._pin = load_model(self.movable, world.gravity, armature=np.zeros(len(joints)))
        self._data = self._pin.createData()
        bodies = [
            ten_of(each.mass, each.lever, each.inertia) if each.mass else np.zeros(10)
            for each in list(self._pin.inertias)[1:]
        ]
        resist = [[getattr(joint, name) for joint in joints] for name in ("damping", "friction")]
        rest = [np.zeros(len(joints)), [joint.armature for joint in joints]]
        self.numbers = np.concatenate([*bodies, *resist, *rest])

    @staticmethod
    def _check(robot: Robot, movable: MovableBody) -> None:
        what = f'Robot "{robot.name}", {movable.model.path}'
        joints = movable.model.joints
        if not movable.fixed_base:
            raise IdentificationError(
                f"{what} floats; parameters are identified on a fixed base: hang the robot up, and "
                "pass Robot(..., fixed_base=True)."
            )
        if not joints:
            raise IdentificationError(f"{what} has no movable joint.")
        odd = [joint.name for joint in joints if joint.stiffness or joint.mimic is not None]
        if odd:
            raise IdentificationError(
                f'{what}: the joint "{odd[0]}" has a spring or follows another, which is not '
                'identified yet; set JointSettings(stiffness=0.0, mimic=Mimic("")).'
            )
        if movable.model.couplings:
            raise IdentificationError(
                f"{what}: what a motor bears of coupled joints is not known, so they are not "
                "identified; uncouple them, and set Robot(couplings=())."
            )

    # Unknowns -------------------------------------------------------------------------------

    def parameters(self, unknowns: Sequence[Unknown]) -> list[Parameter]:
        """Return the unknown numbers, in the order given.

        Raises:
            ComponentNotFoundError: If the robot has no link or joint of a name.
            IdentificationError: If something is named twice, or a link cannot move.
        """
        found: dict[str, Parameter] = {}
        for unknown in unknowns:
            for each in self._parameters_of(unknown):
                if each.name in found:
                    raise IdentificationError(f'"{each.name}" is named twice.')
                found[each.name] = each
        masses = {each.of for each in found.values() if each.kind == "mass"}
        both = [each.of for each in found.values() if each.kind == "inertia" and each.of in masses]
        if both:
            raise IdentificationError(f'The mass of "{both[0]}" is named twice: inertia has it.')
        return list(found.values())

    def _parameters_of(self, unknown: Unknown) -> list[Parameter]:
        kind = unknown.kind
        prior = unknown.mean, unknown.deviation
        if kind == "delay":
            return [Parameter(kind, "", "", "s", 0.0, *prior)]
        movable = [
            body.name
            for body, frame in zip(self.movable.model.bodies, frames_of(self.movable), strict=True)
            if self._pin.frames[frame].parentJoint > 0 and (kind == "payload" or body.mass > 1e-9)
        ]
        known = movable if kind in LINKS else list(self.joints)
        what = "link that moves" if kind in LINKS else "joint"
        if unknown.of and unknown.of not in known:
            raise ComponentNotFoundError(what, unknown.of, f'Robot "{self.robot.name}"', known)
        names = [unknown.of] if unknown.of else known
        return [each for name in names for each in self._of_one(kind, name, prior)]

    def _of_one(self, kind: str, name: str, prior: tuple[float, float | None]) -> list[Parameter]:
        if kind == "payload":
            return [Parameter(kind, name, "", "kg", 0.0, *prior)]
        if kind in LINKS:
            body = next(each for each in self.movable.model.bodies if each.name == name)
            ten = ten_of(body.mass, body.center, body.inertia)
            if kind == "mass":
                return [Parameter(kind, name, "", "kg", body.mass, *prior)]
            return [
                Parameter(kind, name, part, unit, float(value))
                for part, unit, value in zip(TEN, UNITS, ten, strict=True)
            ]
        place = self.joints.index(name)
        length, torque = self.units[place], _TORQUE[self.units[place]]
        unit = {
            "damping": f"{torque} s/{length}",
            "armature": "kg m²" if length == "rad" else "kg",
            "gain": "1",
            "encoder": length,
        }.get(kind, torque)
        joint = self.movable.model.joints[place]
        nominal = 1.0 if kind == "gain" else float(getattr(joint, kind, 0.0))
        return [Parameter(kind, name, "", unit, nominal, *prior)]

    def direction(self, parameter: Parameter) -> Vector:
        """Return the change of `numbers` by a parameter's unit; zeros if it is none of them."""
        found = np.zeros(len(self.numbers))
        kind, count = parameter.kind, len(self.joints)
        if kind in LINKS:
            place = self.movable.model.links.index(parameter.of)
            frame = self._pin.frames[frames_of(self.movable)[place]]
            if kind == "inertia":
                ten = np.eye(10)[TEN.index(parameter.part)]
            elif kind == "payload":
                ten = np.eye(10)[0]
            else:
                body = self.movable.model.bodies[place]
                ten = ten_of(body.mass, body.center, body.inertia) / body.mass
            start = 10 * (frame.parentJoint - 1)
            found[start : start + 10] = carried(frame.placement.homogeneous) @ ten
        elif kind in ("damping", "friction", "stribeck", "armature"):
            row = ("damping", "friction", "stribeck", "armature").index(kind)
            found[(10 + row) * count + self.joints.index(parameter.of)] = 1.0
        return found

    # Torques --------------------------------------------------------------------------------

    def columns(
        self, path: Path, directions: Vector, signs: Vector, dry: Vector | None = None
    ) -> Vector:
        """Return the torques of changes of `numbers` along a path.

        Args:
            path: The motion.
            directions: The changes, shape (numbers, columns).
            signs: Velocities that dry friction depends on, shape (samples, joints).
            dry: What a unit of each joint's dry friction takes of the torques, as of `dry`; None:
                that of its own joint.

        Returns:
            Shape (samples, joints, columns), in N m or N.
        """
        count = len(self.joints)
        q, v, a = path.own, path.velocities, path.accelerations
        found = np.empty((len(q), count, directions.shape[1]))
        bodies = np.ascontiguousarray(directions[: 10 * count])
        if bodies.any():
            regress, model, data = pinocchio.computeJointTorqueRegressor, self._pin, self._data
            for place, (q_k, v_k, a_k) in enumerate(zip(q, v, a, strict=True)):
                own = regress(model, data, q_k, v_k, a_k).reshape(count, -1)  # flat of one joint
                np.dot(own, bodies, out=found[place])
        else:
            found[:] = 0.0
        rest = directions[10 * count :].reshape(4, count, -1)
        sign = np.sign(signs)
        stribeck = sign * np.exp(-np.abs(signs) / STRIBECK)
        for motion, of in zip((path.ends, sign, stribeck, a), rest, strict=True):
            if of.any():
                torques = motion[:, :, None] * of
                found += torques if dry is None or motion is not sign else dry @ torques
        return found

    def friction(self, path: Path, numbers: Vector) -> Vector:
        """Return the dry friction of each joint, shape (samples, joints), in N m or N."""
        count = len(self.joints)
        found: Vector = np.sign(path.ends) * numbers[11 * count : 12 * count]
        return found

    def dry(self, path: Path, stencil: Vector, numbers: Vector) -> Vector:
        """Return what a unit of each joint's dry friction takes of the torques of a step.

        DART and our Pinocchio damp a step's velocity first, and then let dry friction change it: at
        the velocity where the step ends, the damping was more by this. MuJoCo applies both at once,
        and a unit takes a unit.

        Args:
            path: The motion.
            stencil: Its derivatives, as of `stencil`.
            numbers: Numbers of the robot.

        Returns:
            Shape (samples, joints, joints).
        """
        count = len(self.joints)
        damping = path.period * np.diag(numbers[10 * count : 11 * count])
        damped = path.period**2 * stencil[2]
        return np.linalg.solve(damped - damping, damped).swapaxes(1, 2)

    def stencil(self, path: Path, numbers: Vector) -> Vector:
        """Return the derivatives of the torques by three neighboring positions.

        Returns:
            By the position before, its own and after, shape (3, samples, joints, joints).
        """
        count, h = len(self.joints), path.period
        model = self._pin.copy()
        for joint in range(count):
            model.inertias[joint + 1] = pinocchio.Inertia.FromDynamicParameters(
                numbers[10 * joint : 10 * joint + 10]
            )
        damping, armature = (np.diag(numbers[(10 + row) * count :][:count]) for row in (0, 3))
        data = model.createData()
        by_q, by_v, mass = (np.empty((len(path.own), count, count)) for _ in range(3))
        derive = pinocchio.computeRNEADerivatives
        moving = zip(path.own, path.velocities, path.accelerations, strict=True)
        for place, state in enumerate(moving):
            by_q[place], by_v[place], mass[place] = derive(model, data, *state)
        mass = np.triu(mass) + np.triu(mass, 1).swapaxes(1, 2)
        second = (mass + armature) / h**2
        if path.instant:
            first = (by_v + damping) / (2 * h)
            return np.stack([second - first, by_q - 2 * second, second + first])
        return np.stack([
            second - by_v / h, by_q + (by_v - damping) / h - 2 * second, second + damping / h
        ])  # fmt: skip


def _with_held(movable: MovableBody, held: Sequence[str]) -> MovableBody:
    """Return a robot some of whose joints are fixed at 0, with those that follow them."""
    names = [joint.name for joint in movable.model.joints]
    for name in held:
        if name not in names:
            raise ComponentNotFoundError("joint", name, f'Robot "{movable.name}"', names)
    bodies = tuple(
        replace(body, joint=None, axis=np.zeros(3))
        if body.joint is not None
        and (body.joint.name in held or (body.joint.mimic and body.joint.mimic.leader in held))
        else body
        for body in movable.model.bodies
    )
    return replace(movable, model=replace(movable.model, bodies=bodies))
