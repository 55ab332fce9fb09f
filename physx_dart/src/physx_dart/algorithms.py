"""Pinocchio's algorithms for a world's robots and objects, whatever engine simulates them.

All states are those of `physx_core.interfaces.layout`, all results are new arrays of float64 in
C order, so that ``torch.from_numpy`` takes them as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Self

import numpy as np
import pinocchio

from physx_core.interfaces.backend import Vector
from physx_core.world import World
from physx_dart.parts import Mover, Parts, read_parts
from physx_dart.pinocchio_models import frames_of, load_model
from physx_dart.resistance import Resistance
from physx_dart.rotations import poses_from_matrices

_WORLD_AXES = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED


class MoverAlgorithms:
    """Pinocchio's algorithms for one robot or object.

    Attributes:
        model: Pinocchio's model, with gravity and the rotors' inertia.
        data: What its algorithms write to.
        frames: Frame of each link, by its place in the robot.
        resistance: What resists its joints' motion; part of the dynamics.
    """

    def __init__(self, mover: Mover, gravity: tuple[float, ...]) -> None:
        self.resistance = Resistance(mover)
        self.model = load_model(mover, gravity, armature=self.resistance.armature)
        self.data = self.model.createData()
        self.frames = frames_of(self.model, mover)
        self._first = 1 if mover.fixed_base else 2

    def poses(self, q: Vector) -> Vector:
        """Return the poses of all links, shape (links, 7)."""
        pinocchio.framesForwardKinematics(self.model, self.data, q)
        placements = self.data.oMf
        return poses_from_matrices(np.array([placements[i].homogeneous for i in self.frames]))

    def velocities(self, q: Vector, v: Vector) -> Vector:
        """Return the velocities of all links' origins along the world's axes, (links, 6)."""
        model, data = self.model, self.data
        pinocchio.forwardKinematics(model, data, q, v)
        pinocchio.updateFramePlacements(model, data)
        found = [pinocchio.getFrameVelocity(model, data, i, _WORLD_AXES) for i in self.frames]
        return np.array([velocity.vector for velocity in found])

    def forward(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations that torques cause, resistance included."""
        resisted = tau - self.resistance.torques(q, v)
        return pinocchio.aba(self.model, self.data, q, v, resisted)

    def inverse(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return the torques that cause accelerations, resistance included."""
        return pinocchio.rnea(self.model, self.data, q, v, a) + self.resistance.torques(q, v)

    def joint_wrenches(self, q: Vector, v: Vector, a: Vector, outer: Vector) -> Vector:
        """Return what each joint carries, shape (joints, 6); `outer` acts on the links."""
        model, data = self.model, self.data
        pinocchio.framesForwardKinematics(model, data, q)
        forces = pinocchio.StdVec_Force()
        forces.extend(pinocchio.Force.Zero() for _ in range(model.njoints))
        for link in np.flatnonzero(outer.any(axis=1)):
            frame = self.frames[link]
            joint = model.frames[frame].parentJoint
            place = pinocchio.SE3(np.eye(3), data.oMf[frame].translation)
            forces[joint] += data.oMi[joint].actInv(place.act(pinocchio.Force(outer[link])))
        pinocchio.rnea(model, data, q, v, a, forces)
        found = [data.f[i].vector for i in range(self._first, model.njoints)]
        return np.array(found).reshape(-1, 6)

    def mass(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        matrix = np.triu(pinocchio.crba(self.model, self.data, q))
        return matrix + np.triu(matrix, 1).T

    def jacobian(self, link: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian of a point of a link along the world's axes, shape (6, nv)."""
        model, data, frame = self.model, self.data, self.frames[link]
        found = pinocchio.computeFrameJacobian(model, data, q, frame, _WORLD_AXES)
        pinocchio.framesForwardKinematics(model, data, q)
        x, y, z = data.oMf[frame].rotation @ point
        arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        found = np.array(found, order="C").reshape(6, -1)  # one column comes as a vector
        found[:3] -= arm @ found[3:]
        return found

    def derivatives(self, q: Vector, v: Vector, tau: Vector) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward` by positions, velocities and torques."""
        resisted = tau - self.resistance.torques(q, v)
        found = pinocchio.computeABADerivatives(self.model, self.data, q, v, resisted)
        by_q, by_v, inverse = (np.array(matrix, order="C") for matrix in found)
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        by_q -= inverse * self.resistance.stiffness
        by_v -= inverse * self.resistance.damping
        return by_q, by_v, inverse


class Algorithms:
    """Pinocchio's algorithms for all of a world. Arrays are not checked here.

    ``Algorithms.of(world)`` makes one; the positions' quaternions must have length 1.

    Attributes:
        movers: One for each robot, then each object that moves.
    """

    def __init__(self, parts: Parts) -> None:
        self.movers = tuple(MoverAlgorithms(each, parts.world.gravity) for each in parts.movers)

    @classmethod
    def of(cls, world: World) -> Self:
        """Return the algorithms of a world.

        Raises:
            ModelError: A robot cannot be loaded; the message says why.
        """
        return cls(read_parts(world))

    def body_poses(self, q: Vector) -> Vector:
        """Return the poses of all bodies, shape (bodies, 7)."""
        return np.concatenate([each.poses(q[a]) for each, a, _ in self._slices()])

    def body_velocities(self, q: Vector, v: Vector) -> Vector:
        """Return the velocities of all bodies' origins along the world's axes, (bodies, 6)."""
        return np.concatenate([each.velocities(q[a], v[b]) for each, a, b in self._slices()])

    def forward_dynamics(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) cause in a state."""
        return np.concatenate([x.forward(q[a], v[b], tau[b]) for x, a, b in self._slices()])

    def inverse_dynamics(self, q: Vector, v: Vector, acceleration: Vector) -> Vector:
        """Return the torques, shape (nv,), that cause accelerations (nv,) in a state."""
        slices = self._slices()
        return np.concatenate([x.inverse(q[a], v[b], acceleration[b]) for x, a, b in slices])

    def joint_wrenches(self, q: Vector, v: Vector, a: Vector, outer: Vector) -> Vector:
        """Return what the joints carry in a state, shape (joints, 6).

        Args:
            q: Positions.
            v: Velocities.
            a: Accelerations.
            outer: What acts on the bodies from outside, shape (bodies, 6): force, and torque about
                the body's origin, along the world's axes.
        """
        found, begin = [], 0
        for each, x, y in self._slices():
            end = begin + len(each.frames)
            found.append(each.joint_wrenches(q[x], v[y], a[y], outer[begin:end]))
            begin = end
        return np.concatenate(found)

    def mass_matrix(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        return self._diagonal([each.mass(q[a]) for each, a, _ in self._slices()])

    def jacobian(self, body: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point of a body, by its place in the layout."""
        whole = np.zeros((6, sum(each.model.nv for each in self.movers)))
        for each, a, b in self._slices():
            if body < len(each.frames):
                whole[:, b] = each.jacobian(body, q[a], point)
                return whole
            body -= len(each.frames)
        return whole

    def forward_dynamics_derivatives(
        self, q: Vector, v: Vector, tau: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward_dynamics` by positions, velocities and torques."""
        found = [each.derivatives(q[a], v[b], tau[b]) for each, a, b in self._slices()]
        by_q, by_v, by_tau = (self._diagonal(blocks) for blocks in zip(*found, strict=True))
        return by_q, by_v, by_tau

    def _slices(self) -> Iterator[tuple[MoverAlgorithms, slice, slice]]:
        nq = nv = 0
        for each in self.movers:
            yield each, slice(nq, nq + each.model.nq), slice(nv, nv + each.model.nv)
            nq, nv = nq + each.model.nq, nv + each.model.nv

    def _diagonal(self, blocks: Any) -> Vector:
        """Return a matrix with square blocks along its diagonal."""
        if len(self.movers) == 1:
            return blocks[0]
        whole = np.zeros((sum(map(len, blocks)),) * 2)
        begin = 0
        for block in blocks:
            end = begin + len(block)
            whole[begin:end, begin:end] = block
            begin = end
        return whole
