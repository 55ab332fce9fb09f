"""Torques of a robot along a path: linear in its unknowns, by Pinocchio."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pinocchio

from physx_core.errors import ComponentNotFoundError
from physx_core.rotations import from_rotation_vector_rows, to_matrix_rows
from physx_core.typing import Array, Vector
from physx_dart.pinocchio.models import frames_of, load_model, load_stepping_model
from physx_identify.errors import IdentificationError
from physx_identify.estimation.base import COORDINATES, Base, Imu
from physx_identify.estimation.inertia import TEN, UNITS, carried, ten_of
from physx_identify.unknowns import LINKS, Parameter, Unknown
from physx_sim import Robot, World
from physx_sim.engines import MovableBody, read_parts

_TORQUE = {"rad": "N m", "m": "N"}
_RESISTANCE = ("damping", "friction", "stribeck", "armature")
GRAVITY = (0.0, 0.0, -9.81)
"""In m/s²."""
STRIBECK = 0.1
"""Velocity at which Stribeck friction has fallen to 1/e, in rad/s or m/s."""


@dataclass(frozen=True)
class Path:
    """A motion in discrete time, sampled at physics steps as the engines step them.

    Attributes:
        positions: Before, at and after each sample, shape (samples + 2, coordinates), in rad or m;
            of a floating base with an inertial sensor, that sensor's readings.
        period: In s.
        instant: Whether torques are those at the instants of the samples, instead of held from each
            sample to the next.
        base: What is known of a floating base, whose coordinates come before the joints'.
    """

    positions: Vector
    period: float
    instant: bool = False
    base: Base | Imu | None = None

    @property
    def own(self) -> Vector:
        """Positions, shape (samples, joints)."""
        return self.positions[1:-1]

    @property
    def configurations(self) -> Vector:
        """Positions as Pinocchio takes them, with quaternions, shape (samples, numbers)."""
        if self.base is None:
            return self.own
        if isinstance(self.base, Imu):
            upright = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(self.own), 1))
            return np.concatenate([upright, self.own[:, 6:]], axis=1)
        turned = self.base.turned(self.positions[:, 3:6])[1:-1]
        return np.concatenate([self.own[:, :3], turned, self.own[:, 6:]], axis=1)

    @property
    def velocities(self) -> Vector:
        """Velocities that centrifugal torques depend on, shape (samples, joints)."""
        return self._motion[0]

    @property
    def ends(self) -> Vector:
        """Velocities that resistance depends on: of an engine, those at the end of the step."""
        return self._motion[1]

    @property
    def accelerations(self) -> Vector:
        """Shape (samples, joints)."""
        return self._motion[2]

    @property
    def readings(self) -> Vector:
        """Those of an inertial sensor around each sample, shape (3, samples, 6)."""
        base = self.positions[:, :6]
        return np.stack([base[:-2], base[1:-1], base[2:]])

    @cached_property
    def _motion(self) -> tuple[Vector, Vector, Vector]:
        q, h = self.positions, self.period
        velocities = (q[2:] - q[:-2]) / (2 * h) if self.instant else (q[1:-1] - q[:-2]) / h
        ends = velocities.copy() if self.instant else np.diff(q[1:], axis=0) / h
        found = velocities, ends, np.diff(q, 2, axis=0) / h**2
        if isinstance(self.base, Imu):
            motion = self.base.motion(self.readings, h, self.instant)
            for each, own in zip(found, motion, strict=True):
                each[:, :6] = own
        return found


class Model:
    """A robot as numbers that its torques are linear in.

    The numbers are ten of each coordinate, those of the body that it moves last, then damping,
    friction, Stribeck friction and armature of each. Of a floating base, the first six coordinates
    are those of `Base`; the bodies of all but its last one are empty.

    Attributes:
        robot: The robot.
        movable: The robot as read from its file.
        joints: Names of its joints.
        coordinates: Names of what its torques belong to: those of a floating base, and the joints.
        numbers: All numbers as in its file and settings, shape (14 * coordinates,).
        gravity: In m/s².
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
            IdentificationError: If it has no joints, or joints follow others, are coupled, or have
                springs.
        """
        self.robot, self.gravity = robot, tuple(gravity)
        world = World(robots=[robot], gravity=self.gravity)
        self.movable = _with_held(read_parts(world).movables[0], held)
        joints = self.movable.model.joints
        self._check(robot, self.movable)
        self.joints = tuple(joint.name for joint in joints)
        self.units = tuple(joint.unit for joint in joints)
        self.floating = not self.movable.fixed_base
        self.coordinates = (*(COORDINATES if self.floating else ()), *self.joints)
        count, base = len(self.coordinates), len(self.coordinates) - len(joints)
        load = load_stepping_model if self.floating else load_model
        self._pin = load(self.movable, world.gravity, armature=np.zeros(count))
        self._weightless = self._pin.copy()
        self._weightless.gravity.setZero()
        self._data = self._pin.createData()
        bodies = [
            ten_of(each.mass, each.lever, each.inertia) if each.mass else np.zeros(10)
            for each in list(self._pin.inertias)[1:]
        ]
        self._empty = count - len(bodies)
        resist = np.zeros((4, count))
        for row, name in enumerate(_RESISTANCE):
            resist[row, base:] = [getattr(joint, name, 0.0) for joint in joints]
        self.numbers = np.concatenate([np.zeros(10 * self._empty), *bodies, resist.ravel()])

    @staticmethod
    def _check(robot: Robot, movable: MovableBody) -> None:
        what = f'Robot "{robot.name}", {movable.model.path}'
        joints = movable.model.joints
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

    def check_fixed(self, what: str) -> None:
        """Check that the base is fixed, as something needs.

        Raises:
            IdentificationError: If it floats.
        """
        if self.floating:
            raise IdentificationError(
                f'{what} need a fixed base, but robot "{self.robot.name}" floats. Leave them out.'
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
        kind, count = parameter.kind, len(self.coordinates)
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
            start = 10 * (frame.parentJoint - 1 + self._empty)
            found[start : start + 10] = carried(frame.placement.homogeneous) @ ten
        elif kind in _RESISTANCE:
            place = self.coordinates.index(parameter.of)
            found[(10 + _RESISTANCE.index(kind)) * count + place] = 1.0
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
        count = len(self.coordinates)
        q, v, a = path.configurations, path.velocities, path.accelerations
        found = np.zeros((len(q), count, directions.shape[1]))
        bodies = np.ascontiguousarray(directions[10 * self._empty : 10 * count])
        if bodies.any():
            regress, model, data = pinocchio.computeJointTorqueRegressor, self._of(path), self._data
            own = np.empty((len(q), count, len(bodies)))
            for place, (q_k, v_k, a_k) in enumerate(zip(q, v, a, strict=True)):
                own[place] = regress(model, data, q_k, v_k, a_k)
            np.dot(own.reshape(-1, len(bodies)), bodies, out=found.reshape(-1, found.shape[2]))
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
        count = len(self.coordinates)
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
        count = len(self.coordinates)
        damping = path.period * np.diag(numbers[10 * count : 11 * count])
        damped = path.period**2 * stencil[2]
        if isinstance(path.base, Imu):  # readings are no positions
            _, of_a = path.base.slopes(path.readings, path.period, path.instant)
            damped[..., :6] = stencil[2][..., :6] @ np.linalg.inv(of_a[2])
        return np.linalg.solve(damped - damping, damped).swapaxes(1, 2)

    def stencil(self, path: Path, numbers: Vector) -> Vector:
        """Return the derivatives of the torques by three neighboring positions.

        Returns:
            By the position before, its own and after, shape (3, samples, joints, joints).
        """
        count, h = len(self.coordinates), path.period
        model = self._of(path).copy()
        for joint, ten in enumerate(numbers[10 * self._empty : 10 * count].reshape(-1, 10), 1):
            inertia = pinocchio.Inertia
            empty = not ten[0]  # as the part of a floating base that only translates
            model.inertias[joint] = inertia.Zero() if empty else inertia.FromDynamicParameters(ten)
        damping, armature = (np.diag(numbers[(10 + row) * count :][:count]) for row in (0, 3))
        data = model.createData()
        by_q, by_v, mass = (np.empty((len(path.own), count, count)) for _ in range(3))
        derive = pinocchio.computeRNEADerivatives
        moving = zip(path.configurations, path.velocities, path.accelerations, strict=True)
        for place, state in enumerate(moving):
            by_q[place], by_v[place], mass[place] = derive(model, data, *state)
        mass = np.triu(mass) + np.triu(mass, 1).swapaxes(1, 2)
        second = (mass + armature) / h**2
        if path.instant:
            first = (by_v + damping) / (2 * h)
            found = np.stack([second - first, by_q - 2 * second, second + first])
        else:
            before, after = second - by_v / h, second + damping / h
            found = np.stack([before, by_q + (by_v - damping) / h - 2 * second, after])
        if isinstance(path.base, Imu):
            of_v, of_a = path.base.slopes(path.readings, h, path.instant)
            found[..., :6] = by_v[..., :6] @ of_v + mass[..., :6] @ of_a
        return found

    def _of(self, path: Path) -> Any:
        """Return Pinocchio's model for a path: specific forces have gravity in them."""
        return self._weightless if isinstance(path.base, Imu) else self._pin

    def sensor_pose(self, frame: str) -> Vector:
        """Return the pose of a frame in a floating base, a homogeneous matrix of shape (4, 4).

        Raises:
            ComponentNotFoundError: If no frame that is fixed to the base has this name.
        """
        frames = zip(self.movable.model.links, frames_of(self.movable), strict=True)
        fixed = {name: self._pin.frames[place] for name, place in frames}
        root = next(iter(fixed.values())).parentJoint
        fixed = {name: each for name, each in fixed.items() if each.parentJoint == root}
        if frame not in fixed:
            where = f'The base of robot "{self.robot.name}"'
            raise ComponentNotFoundError("frame", frame, where, list(fixed))
        found: Vector = fixed[frame].placement.homogeneous
        return found

    # Contacts -------------------------------------------------------------------------------

    def moved(self, link: str) -> Array:
        """Return which coordinates move a link, shape (coordinates,).

        Raises:
            ComponentNotFoundError: If there is no link of a name.
        """
        links = self.movable.model.links
        if link not in links:
            raise ComponentNotFoundError("link", link, f'Robot "{self.robot.name}"', links)
        joint = self._pin.frames[frames_of(self.movable)[links.index(link)]].parentJoint
        found = np.zeros(len(self.coordinates), bool)
        for each in list(self._pin.supports[joint])[1:]:
            first = self._pin.idx_vs[each]
            found[first : first + self._pin.nvs[each]] = True
        return found

    def wrenches(self, path: Path, link: str, readings: Vector, axes: str) -> tuple[Vector, Vector]:
        """Return what wrenches on a link add to the torques along a path.

        Args:
            path: The motion.
            link: The link, at whose origin they act.
            readings: Forces in N and moments in N m of each step, shape (samples, 6).
            axes: Whether they are along the axes of the ``"world"``, or of the ``"link"`` where a
                step ends.

        Returns:
            Torques by the readings, shape (samples, coordinates, 6); and derivatives of the torques
            by the positions, shape (samples, coordinates, coordinates).
        """
        place = frames_of(self.movable)[self.movable.model.links.index(link)]
        count, data = len(self.coordinates), self._data
        twists, turns = np.empty((len(path.own), 6, count)), np.empty((len(path.own), 3, 3))
        local = pinocchio.ReferenceFrame.LOCAL
        for row, q in enumerate(path.configurations):
            pinocchio.computeJointJacobians(self._pin, data, q)
            turns[row] = pinocchio.updateFramePlacement(self._pin, data, place).rotation.T
            own = pinocchio.getFrameJacobian(self._pin, data, place, local)
            twists[row] = own.reshape(6, count)
        if axes == "link":
            turning = np.einsum("kij,kj->ki", twists[:, 3:], path.period * path.ends)
            turns = to_matrix_rows(from_rotation_vector_rows((not path.instant) * turning))
        linear, angular = twists[:, :3].swapaxes(1, 2), twists[:, 3:].swapaxes(1, 2)
        force, moment = (
            np.einsum("kij,kj->ki", turns, each)[:, None] for each in np.split(readings, 2, axis=1)
        )
        # The twist by a nearer joint is turned by a farther one.
        near = linear[:, :, None], angular[:, :, None]
        far = linear[:, None], angular[:, None]
        moved = np.cross(near[1], far[0]) + np.cross(near[0], far[1])
        joint = np.repeat(np.arange(self._pin.njoints), self._pin.nvs)
        slopes = np.einsum("kijd,kld->kij", moved, force)
        slopes += np.einsum("kijd,kld->kij", np.cross(near[1], far[1]), moment)
        slopes *= joint[:, None] < joint
        if axes == "world":
            slopes += linear @ np.cross(force, angular).swapaxes(1, 2)
            slopes += angular @ np.cross(moment, angular).swapaxes(1, 2)
        if isinstance(path.base, Imu):
            slopes[..., :6] = 0.0  # by readings
        return np.concatenate([linear @ turns, angular @ turns], axis=2), slopes


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
