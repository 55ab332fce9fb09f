"""A robot or object stepped with Pinocchio's algorithms.

Pinocchio has no simulator, so the step is implemented here in the same way as DART's:
semi-implicit Euler with implicit damping and springs; impulses for contacts, limits, servos, and
Coulomb friction; and a floating base integrated with its velocities in the world frame. Unlike
DART's, gyroscopic forces of objects that touch something are those of the middle of a step.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio
from numpy import add, multiply

from physx_core.rotations import cross_rows, rotate_back, to_matrix
from physx_core.typing import Records, Vector
from physx_dart.pinocchio.constraints import Constraints, Warmth, constrained, limited
from physx_dart.pinocchio.contacts import ContactFinder, Indices, supports_of
from physx_dart.pinocchio.limits import JointConstraints
from physx_dart.pinocchio.models import (
    frames_of,
    load_stepping_model,
    twists_of,
    write_inertias,
)
from physx_dart.pinocchio.solver import ImpulseSolver
from physx_sim import CONTACT, World
from physx_sim.engines import MovableBody, RobotEngine, Static, rk4_step, twist_change

_UNSEEN = 10
"""Steps between checks of whether a limit might have acted."""
_SOLVED = 1e-9
"""Change of velocities, in m/s or rad/s, that is not made, as constraints are no more exact."""


class PinocchioRobot(RobotEngine):
    """The state of a robot or object, and its stepping.

    Internally, the velocities of a floating base follow `load_stepping_model`.
    """

    def __init__(
        self,
        movable: MovableBody,
        world: World,
        statics: Sequence[Static],
        solver: ImpulseSolver,
        features: Sequence[str],
    ) -> None:
        """Load the models."""
        super().__init__(movable)
        self._period = world.period
        resists, dt = self.resistance, world.period
        implicit = resists.armature + dt * resists.damping + dt * dt * resists.stiffness
        self.model_in_motion = load_stepping_model(movable, world.gravity, armature=implicit)
        self.data = self.model_in_motion.createData()
        # Constraints act on the robot without its implicit damping, as in DART.
        self._model = self.model_in_motion.copy()
        self._model.armature = np.asarray(resists.armature, np.float64)
        self._data = self._model.createData()
        self.frames = frames_of(movable)
        self._pushes = pinocchio.StdVec_Force()
        self._pushes.extend(pinocchio.Force.Zero() for _ in range(self.model_in_motion.njoints))
        self._more: tuple[Any, ...] = ()  # the wrenches, if there are any
        self._joints = JointConstraints(self.model.joints, dt, self.base)
        self.contact_finder = ContactFinder(
            movable,
            statics if movable.moves else (),
            self.model_in_motion,
            self.data,
            self.frames,
            features,
        )
        self._acted_on = bool(self.contact_finder) or self._joints.acts
        self._tumbles = self.nv == self.base == 6
        self._solver = solver
        self._rk4 = world.integrator == "rk4"
        modes = [joint.mode for joint in self.model.joints]
        forces = np.array([mode == "force" for mode in modes], np.float64)
        self._forces = None if forces.all() else forces
        self._positions, self._velocities = np.zeros(self.nq), np.zeros(self.nv)
        self._earlier, self._before = self._positions, self._velocities
        self._free = self.allowed = self._velocities
        self.gyrates = False  # whether those of the middle of the last step mattered
        self._safe_steps, self._bound = 0, 0.0
        # Multiplying two arrays takes half the time of multiplying an array by a number.
        self._periods, self._motion = np.full(self.nv, dt), np.zeros(self.nv)
        self._twist_source: Vector | None = None  # the velocities from which `_twist` was computed
        self._twist = self._velocities
        self._torques = np.zeros(self.nv)
        self._springs = bool(resists.stiffness.any())
        self._smooth = bool(resists.damping.any() or resists.stiffness.any())
        self._constraints: Constraints | None = None
        self._warmth = Warmth(len(self.contact_finder), len(self._joints.columns))
        # Pinocchio only computes the upper triangle of the inverse mass matrix.
        rows, columns = np.indices((self.nv, self.nv))
        self._mirrored = self.nv * np.minimum(rows, columns) + np.maximum(rows, columns)

    # Stepping -------------------------------------------------------------------------------

    def run(self, n: int) -> None:
        """Simulate n physics steps."""
        if self._rk4:
            for _ in range(n):
                self._step_rk4()
            return
        while n > 0:
            done = 0 if self._acted_on else self._run_free(n)
            n -= done
            if n > 0:
                self._step()
                self._safe_steps = 0
                n -= 1

    def _run_free(self, n: int) -> int:
        """Simulate up to n steps while no limit can act; return how many were simulated.

        Every few steps, check whether the joints stayed slow enough for that; if not, undo those
        steps.
        """
        if self._safe_steps <= 0:
            base = self.base
            q, v = self._positions[self.nq - self.nv + base :], self._velocities[base:]
            self._safe_steps, self._bound = self._joints.safe(q, v)
        steps, done = min(n, self._safe_steps), 0
        while done < steps:
            count = min(_UNSEEN, steps - done)
            state = self._positions, self._velocities, self._earlier, self._before
            if self._smooth:
                for _ in range(count):
                    self._step_free(1, self._net_torques(self._positions, self._velocities))
            else:
                self._step_free(count, self._torques)
            v = self._velocities[self.base :]
            if not v.dot(v) < self._bound:
                self._positions, self._velocities, self._earlier, self._before = state
                self._safe_steps = 0
                return done
            done += count
        self._constraints = None
        self._safe_steps -= done
        return done

    def _step_free(self, count: int, torques: Vector) -> None:
        """Simulate one or more steps with only torques and wrenches acting."""
        model, data, more = self.model_in_motion, self.data, self._more
        periods, motion = self._periods, self._motion
        aba, integrate = pinocchio.aba, pinocchio.integrate
        q, v = self._positions, self._velocities
        earlier, before = q, v
        for _ in range(count):
            earlier, before = q, v
            # A new array, which becomes the new velocities.
            v = aba(model, data, q, v, torques, *more) if more else aba(model, data, q, v, torques)
            multiply(v, periods, v)
            add(v, before, v)
            q = integrate(model, q, multiply(v, periods, motion))
        self._positions, self._velocities, self.allowed = q, v, v
        self._earlier, self._before = earlier, before

    def _net_torques(self, q: Vector, v: Vector) -> Vector:
        """Return the held torques minus those of dampers and springs at the end of the step."""
        resists = self.resistance
        torques = self._torques - resists.damping * v
        if not self._springs:
            return torques
        ahead = q[self.nq - self.nv :] + self._period * v - resists.rest
        return torques - np.where(resists.stiffness, resists.stiffness * ahead, 0.0)

    def _step(self) -> None:
        """Simulate one step with all constraints."""
        free = self.free_velocities()
        self.finish(self.constrained(free))

    def free_velocities(self) -> Vector:
        """Return the velocities (nv,) that the step would end with without constraints."""
        q, v = self._positions, self._velocities
        torques = self._net_torques(q, v) if self._smooth else self._torques
        a = pinocchio.aba(self.model_in_motion, self.data, q, v, torques, *self._more)
        multiply(a, self._periods, a)
        self._free = add(a, v, a)
        return self._free

    def free_derivatives(self) -> tuple[Vector, Vector, Vector]:
        """Return derivatives of `free_velocities` of the last step, each of shape (nv, nv).

        They are w.r.t. positions, along small motions, velocities, and torques.
        """
        q, v, resists, period = self._earlier, self._before, self.resistance, self._period
        found = pinocchio.computeABADerivatives(
            self.model_in_motion, self.data, q, v, self._net_torques(q, v)
        )
        by_q, by_v, inverse = (np.array(matrix, order="C") for matrix in found)
        by_tau = np.triu(inverse) + np.triu(inverse, 1).T
        if self._smooth:
            by_q -= by_tau * resists.stiffness
            by_v -= by_tau * (resists.damping + period * resists.stiffness)
        return period * by_q, np.eye(self.nv) + period * by_v, period * by_tau

    def gyroscopic_derivatives(self) -> tuple[Vector, Vector, Vector]:
        """Return derivatives of what `finish` added in the last step, each of shape (nv, nv).

        They are w.r.t. positions, along small motions, velocities before the step, and those that
        constraints allowed.
        """
        q, v, torques = self._earlier, self._before, self._torques
        middle = 0.5 * (v + self.allowed)
        (late_q, late_v), (early_q, early_v) = (
            [
                np.array(each)
                for each in pinocchio.computeABADerivatives(
                    self.model_in_motion, self.data, q, each, torques
                )[:2]
            ]
            for each in (middle, v)
        )
        by_allowed = 0.5 * self._period * late_v
        return self._period * (late_q - early_q), by_allowed - self._period * early_v, by_allowed

    def finish(self, velocities: Vector) -> None:
        """End the step with the velocities (nv,) that the constraints allow."""
        self.allowed, self.gyrates = velocities, False
        if self._tumbles and velocities is not self._free:
            change = self._gyroscopic(velocities)
            self.gyrates = bool(change.dot(change) > _SOLVED**2)
            if self.gyrates:
                velocities = velocities + change
        self._earlier, self._before = self._positions, self._velocities
        motion = multiply(velocities, self._periods, self._motion)
        self._positions = pinocchio.integrate(self.model_in_motion, self._positions, motion)
        self._velocities = velocities

    def _gyroscopic(self, velocities: Vector) -> Vector:
        """Return the change of velocities at the end of the step by gyroscopic forces, (nv,).

        Those at its start, which are in the free velocities, do work on what constraints turn: a
        disk that rolls along its rim would gain energy. Those in its middle, where constraints have
        changed the velocities by half, do none. The difference is of second order in the period.
        """
        middle = 0.5 * (self._velocities + velocities)
        a = pinocchio.aba(
            self.model_in_motion, self.data, self._positions, middle, self._torques, *self._more
        )
        change: Vector = self._period * a - (self._free - self._velocities)
        return change

    def constrained(self, v: Vector) -> Vector:
        """Return the velocities (nv,) after the impulses of the ground and the joints."""
        part = self.constraints(v)
        if part.touching is None:
            return limited(part, v)
        return constrained([part], self._velocities, v, self._period, self._solver)[0]

    def constraints(self, v: Vector, *, touched: bool = False, tied: bool = False) -> Constraints:
        """Return the constraints in a step.

        Args:
            v: Velocities (nv,) without constraints.
            touched: Whether it touches more than planes.
            tied: Whether it is held by ties. They act on the robot with its implicit damping, so
                that a spring on one side and a torque on the other are in equilibrium.
        """
        q, base = self._positions, self.base
        finder = self.contact_finder
        touching = finder.find(q, v, self._period) if finder else None
        self._constraints = Constraints(
            self._joints,
            self._warmth,
            functools.partial(self._inverse, self.model_in_motion if tied else self._model),
            touching,
            q[self.nq - self.nv + base :],
            v[base:],
            touched=touched or touching is not None,
        )
        return self._constraints

    def _inverse(self, model: Any) -> Vector:
        """Return the inverse of the mass matrix of a model, shape (nv, nv)."""
        upper = pinocchio.computeMinverse(model, self._data, self._positions)
        inverse: Vector = upper.take(self._mirrored)
        return inverse

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the acceleration of free fall, in m/s²."""
        for model in (self.model_in_motion, self._model):
            model.gravity.linear = np.array(gravity)

    def change_masses(self, movable: MovableBody) -> None:
        """Take over the masses and moments of inertia of a description."""
        for model in (self.model_in_motion, self._model):
            write_inertias(movable, model)

    def clear_warm_start(self) -> None:
        """Discard the impulses of the last step."""
        self._warmth.clear_warm_start()

    def place_joints(self) -> Vector:
        """Place the joints in `data`; return the twists for unit velocities, shape (6, nv)."""
        q = self._positions
        return twists_of(pinocchio.computeJointJacobians(self.model_in_motion, self.data, q))

    def joint_positions(self) -> Vector:
        """Return the positions of the joints, shape (joints,)."""
        return self._positions[self.nq - self.nv + self.base :]

    def _step_rk4(self) -> None:
        """Simulate one step with the classic fourth-order Runge-Kutta method."""
        integrate = functools.partial(pinocchio.integrate, self._model)
        state = self._positions, self._velocities
        self._earlier, self._before = state
        found = rk4_step(*state, self._period, self._acceleration, integrate)
        self._positions, self._velocities = found

    def _acceleration(self, q: Vector, v: Vector) -> Vector:
        torques = self._torques - self.resistance.smooth(q, v)
        return pinocchio.aba(self._model, self._data, q, v, torques, self._pushes)

    def contacts(self, first: int, statics: int) -> Records:
        """Return the contacts of the last step.

        Args:
            first: Index of the robot's first link in `Layout.names`.
            statics: Index of the first static body there.
        """
        part = self._constraints
        if part is None or part.touching is None:
            return np.zeros(0, CONTACT)
        links, touched = self.contact_finder.bodies(part.touching.numbers)
        return part.touching.records(first + links, statics + touched, part.impulses, self._period)

    def hold(self, commands: Vector) -> None:
        """Hold commands, shape (joints,), already clipped to their limits."""
        self._joints.targets = commands
        torques = commands if self._forces is None else commands * self._forces
        if self.base:
            self._torques[self.base :] = torques
        else:
            self._torques = torques

    def can_move(self, link: int) -> bool:
        """Return whether a link, given by its index in the model, can move at all."""
        return bool(self.model_in_motion.frames[self.frames[link]].parentJoint > 0)

    def push(self, link: int, force: Vector, torque: Vector, point: Vector, local: bool) -> None:
        """Apply a wrench until `release`."""
        frame = self.model_in_motion.frames[self.frames[link]]
        joint, place = frame.parentJoint, frame.placement
        if not local:
            pinocchio.forwardKinematics(self._model, self._data, self._positions)
            turn = (self._data.oMi[joint].rotation @ place.rotation).T
            force, torque = turn @ force, turn @ torque
        wrench = pinocchio.Force(force, torque + cross_rows(point, force))
        self._pushes[joint] = self._pushes[joint] + place.act(wrench)
        self._more = (self._pushes,)

    def release(self) -> None:
        """Remove all wrenches."""
        if self._more:
            for joint in range(self.model_in_motion.njoints):
                self._pushes[joint] = pinocchio.Force.Zero()
            self._more = ()

    # State ----------------------------------------------------------------------------------

    def positions(self) -> Vector:
        """Return the current positions, shape (nq,), as a new vector."""
        q = self._positions.copy()
        if self.base and q[6] < 0:
            q[3:7] *= -1
        return q

    def velocities(self) -> Vector:
        """Return the current velocities, shape (nv,), as a new vector."""
        if not self.base:
            return self._velocities.copy()
        if self._twist_source is not self._velocities:
            self._twist_source, self._twist = self._velocities, self._velocities.copy()
            self._twist[:3] = rotate_back(self._positions[3:7].tolist(), *self._twist[:3].tolist())
        return self._twist.copy()

    def accelerations(self) -> Vector:
        """Return the accelerations of the last step, shape (nv,)."""
        a = (self._velocities - self._before) / self._period
        if not self.base:
            return a
        earlier, now = self._earlier[3:7].tolist(), self._positions[3:7].tolist()
        a[:6] = twist_change(earlier, self._before, now, self._velocities, self._period)
        return a

    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""
        self._positions, self._velocities = positions.copy(), velocities.copy()
        if self.base:
            rotation = to_matrix(positions[3:7])
            self._velocities[:3] = rotation @ velocities[:3]
        self._earlier, self._before = self._positions, self._velocities
        self._constraints, self._safe_steps = None, 0

    @functools.cached_property
    def supports(self) -> Vector:
        """A matrix with 1 where a velocity (column) moves a joint (row), otherwise 0."""
        return supports_of(self.model_in_motion)

    @functools.cached_property
    def carriers(self) -> Vector:
        """A matrix with 1 where a velocity (column) moves another's axis (row), otherwise 0."""
        return self.supports[self._joint_of_velocity]

    @functools.cached_property
    def parents(self) -> Indices:
        """The joint that carries the joint of each velocity, shape (nv,)."""
        return np.array(self.model_in_motion.parents, np.intp)[self._joint_of_velocity]

    @functools.cached_property
    def _joint_of_velocity(self) -> Indices:
        return np.repeat(np.arange(self.model_in_motion.njoints), self.model_in_motion.nvs)

    def forces(self) -> Vector:
        """Return 1 for velocities of joints that commands drive by torques, otherwise 0, (nv,)."""
        found = np.ones(self.nv)
        found[self.base :] = 1.0 if self._forces is None else self._forces
        return found

    def last_step(self) -> tuple[Vector, Vector, Constraints | None]:
        """Return native positions and velocities before the last step, and its constraints."""
        return self._earlier, self._before, self._constraints

    def native(self) -> tuple[Vector, Vector]:
        """Return a copy of the state in the convention of the stepping model."""
        return self._positions.copy(), self._velocities.copy()

    def set_native(self, positions: Vector, velocities: Vector) -> None:
        """Set a state returned by `native`."""
        self._positions, self._velocities = positions.copy(), velocities.copy()
        self._earlier, self._before = self._positions, self._velocities
        self._constraints, self._safe_steps = None, 0

    def speed(self) -> float:
        """Return the norm of the velocities; NaN or inf if the state is not finite."""
        v = self._velocities  # positions derive from these, so they are finite if these are
        return math.sqrt(v.dot(v))
