"""A robot or object in DART."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from physx_core.rotations import (
    cross_rows,
    from_rotation_vector,
    multiply,
    rotate_back,
    to_matrix,
    to_rotation_vector,
)
from physx_core.typing import Vector
from physx_dart.dart.drives import Drives
from physx_dart.dart.loading import load_skeleton, write_frictions, write_masses
from physx_sim import World
from physx_sim.engines import MovableBody, RobotEngine, base_accelerations, rk4_step


class DartRobot(RobotEngine):
    """A simulated skeleton, plus a second one for the dynamics of other states.

    Attributes:
        skeleton: The simulated skeleton.
        bodies: Its body for each link.
        prepares: Whether `prepare` must be called before each step.
    """

    def __init__(self, movable: MovableBody, world: World) -> None:
        super().__init__(movable)
        self._described = movable
        period, gravity = world.period, world.gravity
        self._period = period
        self.skeleton = load_skeleton(movable)
        self._gravity = gravity
        self._made_shadow: Any = None
        self._drives = Drives(self.model, self.skeleton, period)
        self.prepares = self._drives.acts
        self.bodies = list(self.skeleton.getBodyNodes())
        self._held, self._commands = np.zeros(self.nv), np.zeros(self.nv - self.base)
        self._pushes: list[tuple[int, Vector, Vector, Vector, bool]] = []
        self._change: Vector | None = None
        self._read()

    def hold(self, commands: Vector) -> None:
        """Hold commands, shape (joints,), already clipped to their limits."""
        self._commands = commands
        if self.base:
            self._held[self.base :] = commands
            commands = self._held
        if self.nv > self.base:
            self.skeleton.setCommands(commands)

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the gravity in the dynamics of other states."""
        self._gravity, self._made_shadow = gravity, None

    def change(self, movable: MovableBody) -> None:
        """Take over the masses and the friction of a description."""
        write_masses(self.skeleton, movable)
        if self.skeleton.getNumShapeNodes():
            write_frictions(self.skeleton, movable)
        self._described, self._made_shadow = movable, None

    def prepare(self) -> None:
        """Write what DART is told anew before each step."""
        if self._drives.outer:
            self.skeleton.clearExternalForces()
            for link, force, torque, point, local in self._pushes:
                _push(self.bodies[link], force, torque, point, local)
        self._drives.write(self._commands)

    def clear_warm_start(self) -> None:
        """Make the state alone determine what follows."""
        self._drives.forget()

    def _read(self) -> None:
        """Read the state from DART; must be called after each change."""
        self._q, self._v = self.skeleton.getPositions(), self.skeleton.getVelocities()
        self._quaternion: tuple[float, ...] | None = None
        self._twist: Vector | None = None

    def _orientation(self) -> tuple[float, ...]:
        """Return the base's quaternion x, y, z, w."""
        if self._quaternion is None:
            self._quaternion = from_rotation_vector(*self._q[:3].tolist())
        return self._quaternion

    def positions(self) -> Vector:
        """Return the current positions, shape (nq,), as a new vector."""
        q = self._q
        if not self.base:
            return q.copy()
        found = np.empty(self.nq)
        found[:7], found[7:] = (*q[3:6].tolist(), *self._orientation()), q[6:]
        return found

    def velocities(self) -> Vector:
        """Return the current velocities, shape (nv,), as a new vector."""
        if self._twist is None:
            self._twist = self._in_base(self._v.copy()) if self.base else self._v
        return self._twist.copy()

    def accelerations(self) -> Vector:
        """Return the accelerations of the last step, shape (nv,)."""
        if self._change is not None:
            return self._change.copy()
        a = self.skeleton.getAccelerations()
        if not self.base:
            return a
        x, y, z, *linear = a[:6].tolist()
        orientation = self._orientation()
        change = base_accelerations(orientation, linear, self.velocities())
        a[:6] = (*change, *rotate_back(orientation, x, y, z))
        return a

    def _in_base(self, v: Vector) -> Vector:
        """Convert a base's twist from DART's form: angular, linear, in the world frame."""
        x, y, z, a, b, c = v[:6].tolist()
        orientation = self._orientation()
        v[:6] = (*rotate_back(orientation, a, b, c), *rotate_back(orientation, x, y, z))
        return v

    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""
        self._change = None
        self._place(self.skeleton, positions, velocities)
        self._read()

    def native(self) -> tuple[Vector, Vector]:
        """Return a copy of DART's native state."""
        return self._q.copy(), self._v.copy()

    def set_native(self, positions: Vector, velocities: Vector) -> None:
        """Set a state returned by `native`."""
        self._change = None
        self.skeleton.setPositions(positions)
        self.skeleton.setVelocities(velocities)
        self._read()

    def speed(self) -> float:
        """Return the norm of the velocities; NaN or inf if the state is not finite."""
        self._read()
        q, v = self._q, self._v
        return math.sqrt(v.dot(v)) if math.isfinite(q.dot(q)) else math.nan

    def can_move(self, link: int) -> bool:
        """Return whether a link, given by its index in the model, can move at all."""
        return self.bodies[link].getNumDependentGenCoords() > 0

    def push(self, link: int, force: Vector, torque: Vector, point: Vector, local: bool) -> None:
        """Apply a wrench until `release`."""
        self._pushes.append((link, force, torque, point, local))
        _push(self.bodies[link], force, torque, point, local)

    def release(self) -> None:
        """Remove all wrenches."""
        self._pushes.clear()
        self.skeleton.clearExternalForces()

    def run_rk4(self, n: int, period: float) -> None:
        """Simulate n steps with the classic fourth-order Runge-Kutta method."""
        torques = np.concatenate([np.zeros(self.base), self._commands])
        for _ in range(n):
            q, twist = self.positions(), self.velocities()
            q, v = rk4_step(
                q,
                self._with_world(q, twist),
                period,
                functools.partial(self._rk4_acceleration, torques),
                self._moved,
            )
            self.write(q, self._with_base(q, v))
            self._change = (self.velocities() - twist) / period

    def _rk4_acceleration(self, torques: Vector, q: Vector, v: Vector) -> Vector:
        """Return the derivative of velocities whose linear part is in the world frame."""
        twist = self._with_base(q, v)
        a = self.forward(q, twist, torques, pushed=True)
        if self.base:
            a[:3] += cross_rows(twist[3:6], twist[:3])
        return self._with_world(q, a)

    def _with_world(self, q: Vector, twist: Vector) -> Vector:
        """Return velocities (or the like) with the linear part in the world frame."""
        if not self.base:
            return twist
        return np.concatenate([to_matrix(q[3:7]) @ twist[:3], twist[3:]])

    def _with_base(self, q: Vector, v: Vector) -> Vector:
        """Return the inverse of `_with_world`."""
        return np.concatenate([v[:3] @ to_matrix(q[3:7]), v[3:]]) if self.base else v

    def _moved(self, q: Vector, motion: Vector) -> Vector:
        """Return positions after a motion whose rotation is about the base's own axes."""
        if not self.base:
            return q + motion
        turn = from_rotation_vector(*motion[3:6].tolist())
        quaternion = multiply(q[3:7].tolist(), turn)
        return np.concatenate([q[:3] + motion[:3], quaternion, q[7:] + motion[6:]])

    @property
    def _shadow(self) -> Any:
        if self._made_shadow is None:
            self._made_shadow = load_skeleton(self._described, free=True)
            self._made_shadow.setGravity(list(self._gravity))
            self._made_shadow.setTimeStep(self._period)
            for dof, armature in enumerate(self.resistance.armature):
                if armature:  # as in `Drives`
                    self._made_shadow.getDof(dof).setDampingCoefficient(armature / self._period)
        return self._made_shadow

    def forward(
        self, positions: Vector, velocities: Vector, torques: Vector, *, pushed: bool = False
    ) -> Vector:
        """Return the accelerations caused by torques, including joint resistance.

        Args:
            positions: Shape (nq,).
            velocities: Shape (nv,).
            torques: Shape (nv,).
            pushed: Whether the current wrenches act, too.
        """
        rotation = self._place(self._shadow, positions, velocities)
        self._shadow.clearExternalForces()
        for link, force, torque, point, local in self._pushes if pushed else ():
            _push(self._shadow.getBodyNode(link), force, torque, point, local)
        forces = torques - self.resistance.torques(positions, velocities)
        forces += self.resistance.armature / self._period * velocities
        if rotation is not None:
            forces = np.concatenate([rotation @ forces[3:6], rotation @ forces[:3], forces[6:]])
        self._shadow.setForces(forces)
        self._shadow.computeForwardDynamics()
        a = self._shadow.getAccelerations()
        if rotation is not None:
            linear = a[3:6] @ rotation - cross_rows(velocities[3:6], velocities[:3])
            a = np.concatenate([linear, a[:3] @ rotation, a[6:]])
        return a

    def inverse(self, positions: Vector, velocities: Vector, accelerations: Vector) -> Vector:
        """Return the torques that produce accelerations, including joint resistance."""
        rotation = self._place(self._shadow, positions, velocities)
        a = accelerations
        if rotation is not None:
            linear = rotation @ (a[:3] + cross_rows(velocities[3:6], velocities[:3]))
            a = np.concatenate([rotation @ a[3:6], linear, a[6:]])
        self._shadow.setAccelerations(a)
        self._shadow.computeInverseDynamics(False, False, False)
        forces = self._shadow.getForces()
        if rotation is not None:
            forces = np.concatenate([forces[3:6] @ rotation, forces[:3] @ rotation, forces[6:]])
        forces += self.resistance.armature * accelerations
        return forces + self.resistance.torques(positions, velocities)

    def _place(self, skeleton: Any, positions: Vector, velocities: Vector) -> Vector | None:
        """Set a skeleton's state; return the rotation matrix of a floating base, else None."""
        rotation = None
        if not self.fixed_base:
            quaternion = positions[3:7] / np.linalg.norm(positions[3:7])
            rotation = to_matrix(quaternion)
            vector = to_rotation_vector(quaternion)
            positions = np.concatenate([vector, positions[:3], positions[7:]])
            twist = velocities
            velocities = np.concatenate([rotation @ twist[3:6], rotation @ twist[:3], twist[6:]])
        skeleton.setPositions(positions)
        skeleton.setVelocities(velocities)
        return rotation


def _push(body: Any, force: Vector, torque: Vector, point: Vector, local: bool) -> None:
    """Apply a wrench to a body in DART."""
    body.addExtForce(force, point, local, True)
    body.addExtTorque(torque, local)
