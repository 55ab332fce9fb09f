"""The engine Pinocchio. All calls of pinocchio are in this file.

Pinocchio has algorithms but no simulator, so the step is written here, as DART does it:
semi-implicit Euler with implicit damping, limits and Coulomb friction by impulses, and a floating
base whose position and rotation move with its velocities in the world frame.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio

from physx_core.errors import ModelError
from physx_core.interfaces.backend import Backend, Simulation, Vector
from physx_core.world import World
from physx_dart.engine import RobotEngine, RobotSimulation, read_robots
from physx_dart.limits import JointConstraints, solve
from physx_dart.rotations import (
    matrix_from_quaternion,
    poses_from_matrices,
    product,
    quaternion_from_vector,
)
from physx_dart.urdf import RobotModel


class PinocchioBackend(Backend):
    """Pinocchio, a library of rigid-body algorithms."""

    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation; nothing is drawn at random, the seed has no effect.

        Raises:
            ModelError: A robot cannot be loaded; the message says why.
        """
        return PinocchioSimulation(world)


class PinocchioSimulation(RobotSimulation):
    """Robots of Pinocchio. No contact is simulated: neither of robots nor of one with itself."""

    def __init__(self, world: World) -> None:
        """Build the world.

        Raises:
            ModelError: A robot cannot be loaded; the message says why.
        """
        models = read_robots(world)
        self._parts = [
            PinocchioRobot(model, robot.fixed_base, world)
            for robot, model in zip(world.robots, models, strict=True)
        ]
        super().__init__(world, self._parts)

    def advance(self, n: int) -> None:
        """Simulate n physics steps."""
        for robot in self._parts:
            step = robot.step
            for _ in range(n):
                step()

    def close(self) -> None:
        """Free the world; calling it again does nothing."""
        super().close()
        self._parts = []


class PinocchioRobot(RobotEngine):
    """A model of Pinocchio and the state of one robot."""

    def __init__(self, model: RobotModel, fixed_base: bool, world: World) -> None:
        super().__init__(model, fixed_base)
        self._model = _load(model, fixed_base, world)
        self._data = self._model.createData()
        self._damped = self._model.copy()
        self._damped.armature = self.damping * world.period
        self._damped_data = self._damped.createData()
        self._frames = [
            self._model.getFrameId(link, pinocchio.FrameType.BODY) for link in model.links
        ]
        self._period = world.period
        self._base = 0 if fixed_base else 6
        self._constraints = self._joint_constraints(world.period)
        self._positions, self._velocities = np.zeros(self.nq), np.zeros(self.nv)
        self._torques = np.zeros(self.nv)

    def _joint_constraints(self, period: float) -> JointConstraints | None:
        joints = self.model.joints
        bounds = [(j.lower, j.upper, j.max_velocity) for j in joints]
        lower, upper, fastest = np.array(bounds).reshape(-1, 3).T
        friction = self.friction[self._base :]
        if np.isinf(np.concatenate([lower, upper, fastest])).all() and not friction.any():
            return None
        return JointConstraints(lower, upper, fastest, friction, period)

    def step(self) -> None:
        """Simulate one physics step."""
        q, v, dt, base = self._positions, self._velocities, self._period, self._base
        torques = self._torques - self.damping * v
        a = pinocchio.aba(self._damped, self._damped_data, q, v, torques)
        if base:
            self._step_base(q, v, a)
            return
        v = v + dt * a
        if self._constraints is not None:
            v = self._constrained(q, v)
        self._velocities = v
        self._positions = q + dt * v

    def _step_base(self, q: Vector, v: Vector, a: Vector) -> None:
        dt = self._period
        before = matrix_from_quaternion(q[3:7])
        free = v + dt * a
        # The linear velocity in the world frame changes by R (a + omega x v), as DART has it.
        free[:3] += dt * np.cross(v[3:6], v[:3])
        if self._constraints is not None:
            free = self._constrained(q, free)
        linear, angular = before @ free[:3], before @ free[3:6]
        rotation = product(quaternion_from_vector(dt * angular), q[3:7])
        after = matrix_from_quaternion(rotation)
        self._positions = np.concatenate([q[:3] + dt * linear, rotation, q[7:] + dt * free[6:]])
        self._velocities = np.concatenate([linear @ after, angular @ after, free[6:]])

    def _constrained(self, q: Vector, v: Vector) -> Vector:
        """Return velocities (nv,) after the impulses of limits and friction."""
        constraints, base = self._constraints, self._base
        found = constraints and constraints.impulses(q[self.nq - self.nv + base :], v[base:])
        if not found:
            return v
        index, change, least, most = found
        index = index + base
        inverse = pinocchio.computeMinverse(self._model, self._data, q)
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        impulses = solve(inverse[np.ix_(index, index)], change, least, most)
        return v + inverse[:, index] @ impulses

    def hold(self, torques: Vector) -> None:
        """Hold joint torques, shape (joints,), that are within their limits."""
        self._torques = np.concatenate([np.zeros(self._base), torques])

    def positions(self) -> Vector:
        """Return the present positions, shape (nq,), in a vector of its own."""
        q = self._positions.copy()
        if self._base and q[6] < 0:
            q[3:7] *= -1
        return q

    def velocities(self) -> Vector:
        """Return the present velocities, shape (nv,), in a vector of its own."""
        return self._velocities.copy()

    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""
        self._positions, self._velocities = self._normalized(positions), velocities.copy()

    def native(self) -> tuple[Vector, Vector]:
        """Return the state, copied."""
        return self._positions.copy(), self._velocities.copy()

    def set_native(self, native: tuple[Vector, Vector]) -> None:
        """Set the state to what `native` returned."""
        self._positions, self._velocities = native[0].copy(), native[1].copy()

    def speed(self) -> float:
        """Return the square of the velocities' length; NaN or inf where the state is broken."""
        q, v = self._positions, self._velocities
        return float(v.dot(v)) if math.isfinite(q.dot(q)) else math.nan

    def poses(self, positions: Vector) -> Vector:
        """Return the poses of all links in positions, shape (links, 7)."""
        q = self._normalized(positions)
        pinocchio.framesForwardKinematics(self._model, self._data, q)
        placements = self._data.oMf
        return poses_from_matrices(np.array([placements[i].homogeneous for i in self._frames]))

    def forward(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations that torques cause, resistance included."""
        q = self._normalized(positions)
        torques = torques - self.resistance(velocities)
        return pinocchio.aba(self._model, self._data, q, velocities, torques)

    def inverse(self, positions: Vector, velocities: Vector, accelerations: Vector) -> Vector:
        """Return the torques that cause accelerations, resistance included."""
        q = self._normalized(positions)
        torques = pinocchio.rnea(self._model, self._data, q, velocities, accelerations)
        return torques + self.resistance(velocities)

    def _normalized(self, positions: Vector) -> Vector:
        q = positions.copy()
        if self._base:
            q[3:7] /= np.linalg.norm(q[3:7])
        return q


def _load(model: RobotModel, fixed_base: bool, world: World) -> Any:
    try:
        if fixed_base:
            loaded = pinocchio.buildModelFromXML(model.text)
        else:
            loaded = pinocchio.buildModelFromXML(model.text, pinocchio.JointModelFreeFlyer())
    except ValueError as error:
        raise ModelError(f"Pinocchio cannot load {model.path}: {error}") from error
    loaded.gravity.linear = np.array(world.gravity, np.float64)
    moving = list(loaded.names)[1 if fixed_base else 2 :]
    if moving != [joint.name for joint in model.joints]:
        raise ModelError(f"Pinocchio reads the joints of {model.path} in another order: {moving}.")
    return loaded
