"""The engine DART. All calls of dartpy are in this file.

DART integrates with semi-implicit Euler: velocities first, then positions with the new velocities.
Damping is implicit; position, velocity limits and Coulomb friction are constraints of its solver.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import dartpy
import numpy as np
from dartpy import dynamics, utils
from dartpy.simulation import CollisionDetectorType

from physx_core.errors import ModelError
from physx_core.interfaces.backend import Backend, Simulation, Vector
from physx_core.world import World
from physx_dart.engine import RobotEngine, RobotSimulation, read_robots
from physx_dart.rotations import (
    matrix_from_quaternion,
    poses_from_matrices,
    quaternion_from_vector,
    vector_from_quaternion,
)
from physx_dart.urdf import RobotModel

_WORLD = "world"
_ROOT = "physx root"
"""Name that DART gets for a root link `world`, which it would leave out."""


class DartBackend(Backend):
    """DART, a simulator of articulated bodies."""

    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation; DART draws nothing at random, the seed has no effect.

        Raises:
            ModelError: A robot cannot be loaded; the message says why.
        """
        return DartSimulation(world)


class DartSimulation(RobotSimulation):
    """A world of DART. No contact is simulated: neither of robots nor of a robot with itself."""

    def __init__(self, world: World) -> None:
        """Build the world.

        Raises:
            ModelError: A robot cannot be loaded; the message says why.
        """
        models = read_robots(world)
        self._world = dartpy.simulation.World()
        self._world.setTimeStep(world.period)
        self._world.setGravity(list(world.gravity))
        self._world.setCollisionDetector(CollisionDetectorType.DART)
        sleeping = self._world.getDeactivationOptions()
        sleeping.mEnabled = False
        self._world.setDeactivationOptions(sleeping)
        robots = []
        for robot, model in zip(world.robots, models, strict=True):
            engine = DartRobot(model, robot.fixed_base, world)
            engine.skeleton.setName(robot.name)
            self._world.addSkeleton(engine.skeleton)
            robots.append(engine)
        self._step_world = self._world.step
        super().__init__(world, robots)

    def advance(self, n: int) -> None:
        """Simulate n physics steps."""
        step = self._step_world
        for _ in range(n):
            step(False)

    def close(self) -> None:
        """Free the world; calling it again does nothing."""
        if not self._closed:
            super().close()
            del self._step_world, self._world


class DartRobot(RobotEngine):
    """A skeleton of DART, and a second one on which states are computed without moving the first.

    Attributes:
        skeleton: The skeleton that is simulated.
    """

    def __init__(self, model: RobotModel, fixed_base: bool, world: World) -> None:
        super().__init__(model, fixed_base)
        self.skeleton = _load(model, fixed_base)
        self._shadow = _load(model, fixed_base)
        self._shadow.setGravity(list(world.gravity))
        base = 0 if fixed_base else 6
        joints = [self.skeleton.getJoint(joint.name) for joint in model.joints]
        places = [joint.getIndexInSkeleton(0) for joint in joints]
        self._native = np.array([*range(base), *places], dtype=np.intp)
        self._sorted = bool((self._native == np.arange(self.nv)).all())
        self._bodies = [
            self._shadow.getBodyNode(_ROOT if link == _WORLD else link) for link in model.links
        ]
        self._configure()

    def _configure(self) -> None:
        for joint in self.model.joints:
            native = self.skeleton.getJoint(joint.name)
            native.setPositionLowerLimit(0, joint.lower)
            native.setPositionUpperLimit(0, joint.upper)
            native.setVelocityLowerLimit(0, -joint.max_velocity)
            native.setVelocityUpperLimit(0, joint.max_velocity)
            native.setLimitEnforcement(True)
            native.setDampingCoefficient(0, joint.damping)
            native.setCoulombFriction(0, joint.friction)

    def hold(self, torques: Vector) -> None:
        """Hold joint torques, shape (joints,), that are within their limits."""
        commands = np.zeros(self.nv)
        commands[self._native[self.nv - len(torques) :]] = torques
        self.skeleton.setCommands(commands)

    def positions(self) -> Vector:
        """Return the present positions, shape (nq,), in a vector of its own."""
        q = self._ordered(self.skeleton.getPositions())
        if self.fixed_base:
            return q
        quaternion = quaternion_from_vector(q[:3])
        quaternion = quaternion if quaternion[3] >= 0 else -quaternion
        return np.concatenate([q[3:6], quaternion, q[6:]])

    def velocities(self) -> Vector:
        """Return the present velocities, shape (nv,), in a vector of its own."""
        v = self._ordered(self.skeleton.getVelocities())
        if self.fixed_base:
            return v
        quaternion = quaternion_from_vector(self.skeleton.getPositions()[:3])
        rotation = matrix_from_quaternion(quaternion)
        return np.concatenate([v[3:6] @ rotation, v[:3] @ rotation, v[6:]])

    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""
        self._place(self.skeleton, positions, velocities)

    def native(self) -> tuple[Vector, Vector]:
        """Return the state exactly as DART has it, copied."""
        return self.skeleton.getPositions(), self.skeleton.getVelocities()

    def set_native(self, native: tuple[Vector, Vector]) -> None:
        """Set the state to what `native` returned."""
        self.skeleton.setPositions(native[0])
        self.skeleton.setVelocities(native[1])

    def speed(self) -> float:
        """Return the square of the velocities' length; NaN or inf where the state is broken."""
        v = self.skeleton.getVelocities()
        q = self.skeleton.getPositions()
        return float(v.dot(v)) if math.isfinite(q.dot(q)) else math.nan

    def poses(self, positions: Vector) -> Vector:
        """Return the poses of all links in positions, shape (links, 7)."""
        self._place(self._shadow, positions, np.zeros(self.nv))
        transforms = [body.getWorldTransform().matrix() for body in self._bodies]
        return poses_from_matrices(np.array(transforms))

    def forward(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations that torques cause, resistance included."""
        rotation = self._place(self._shadow, positions, velocities)
        forces = torques - self.resistance(velocities)
        if rotation is not None:
            forces = np.concatenate([rotation @ forces[3:6], rotation @ forces[:3], forces[6:]])
        self._shadow.setForces(self._reordered(forces))
        self._shadow.computeForwardDynamics()
        a = self._ordered(self._shadow.getAccelerations())
        if rotation is not None:
            linear = a[3:6] @ rotation - np.cross(velocities[3:6], velocities[:3])
            a = np.concatenate([linear, a[:3] @ rotation, a[6:]])
        return a

    def inverse(self, positions: Vector, velocities: Vector, accelerations: Vector) -> Vector:
        """Return the torques that cause accelerations, resistance included."""
        rotation = self._place(self._shadow, positions, velocities)
        a = accelerations
        if rotation is not None:
            linear = rotation @ (a[:3] + np.cross(velocities[3:6], velocities[:3]))
            a = np.concatenate([rotation @ a[3:6], linear, a[6:]])
        self._shadow.setAccelerations(self._reordered(a))
        self._shadow.computeInverseDynamics(False, False, False)
        forces = self._ordered(self._shadow.getForces())
        if rotation is not None:
            forces = np.concatenate([forces[3:6] @ rotation, forces[:3] @ rotation, forces[6:]])
        return forces + self.resistance(velocities)

    def _place(self, skeleton: object, positions: Vector, velocities: Vector) -> Vector | None:
        """Set a skeleton's state; return the base's rotation matrix, None for a fixed base."""
        rotation = None
        if not self.fixed_base:
            quaternion = positions[3:7] / np.linalg.norm(positions[3:7])
            rotation = matrix_from_quaternion(quaternion)
            vector = vector_from_quaternion(quaternion)
            positions = np.concatenate([vector, positions[:3], positions[7:]])
            twist = velocities
            velocities = np.concatenate([rotation @ twist[3:6], rotation @ twist[:3], twist[6:]])
        skeleton.setPositions(self._reordered(positions))  # type: ignore[attr-defined]
        skeleton.setVelocities(self._reordered(velocities))  # type: ignore[attr-defined]
        return rotation

    def _ordered(self, native: Vector) -> Vector:
        return native if self._sorted else native[self._native]

    def _reordered(self, vector: Vector) -> Vector:
        if self._sorted:
            return vector
        native = np.empty(self.nv)
        native[self._native] = vector
        return native


def _load(model: RobotModel, fixed_base: bool) -> dynamics.Skeleton:
    options = utils.DartLoaderOptions()
    kind = utils.DartLoaderRootJointType
    options.mDefaultRootJointType = kind.FIXED if fixed_base else kind.FLOATING
    loader = utils.DartLoader()
    loader.setOptions(options)
    text = model.text
    if model.links[0] == _WORLD:
        text = text.replace(f'link="{_WORLD}"', f'link="{_ROOT}"')
        text = text.replace(f'<link name="{_WORLD}">', f'<link name="{_ROOT}">')
    with _captured_messages() as messages:
        skeleton = loader.parseSkeletonString(text, "")
    if skeleton is None:
        raise ModelError(f"DART cannot load {model.path}.{''.join(messages)}")
    return skeleton


@contextmanager
def _captured_messages() -> Iterator[list[str]]:
    """Collect what native code of this process writes to standard error meanwhile."""
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
            messages.append(" It says: " + file.read().decode(errors="replace").strip())
