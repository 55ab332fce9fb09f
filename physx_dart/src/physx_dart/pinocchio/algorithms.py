"""Pinocchio's algorithms for a world's robots and objects, regardless of the simulating engine.

States follow the convention of `physx_sim.layout`. All results are new C-ordered
float64 arrays, which ``torch.from_numpy`` accepts directly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import pinocchio

from physx_core.typing import Vector
from physx_dart.pinocchio.models import frames_of, load_model, twists_of
from physx_sim import World
from physx_sim.engines import Algorithms, MovableBody, Parts, Resistance, read_parts, static_poses

_WORLD_AXES = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
_velocity, _acceleration = pinocchio.getFrameVelocity, pinocchio.getFrameClassicalAcceleration


class MovableAlgorithms:
    """Pinocchio's algorithms for a robot or object.

    Attributes:
        model: Pinocchio's model, with gravity and the rotors' inertia.
        data: Workspace of its algorithms.
        frames: Frame of each link.
        resistance: Resistance of its joints, which is part of the dynamics.
    """

    def __init__(self, model: Any, resistance: Resistance, frames: Sequence[int] = ()) -> None:
        self.model, self.resistance, self.frames = model, resistance, frames
        self.data, self._pool = model.createData(), pinocchio.ModelPool(model, 1)
        self._first = 1 if model.nq == model.nv else 2  # a floating base is a joint, too

    @classmethod
    def load(cls, movable: MovableBody, gravity: tuple[float, ...]) -> Self:
        """Return the algorithms of a robot or object."""
        resistance = Resistance.of(movable)
        model = load_model(movable, gravity, armature=resistance.armature)
        return cls(model, resistance, frames_of(movable))

    def write_motion(self, frame: int, out: Vector) -> None:
        """Write pose, velocity, and acceleration of a frame, after `pinocchio.forwardKinematics`.

        Args:
            frame: The frame.
            out: Shape (19,), in the world frame.
        """
        model, data = self.model, self.data
        out[:7] = self.pose(frame)
        out[7:13] = _velocity(model, data, frame, _WORLD_AXES).vector
        out[13:] = _acceleration(model, data, frame, _WORLD_AXES).vector

    def pose(self, frame: int) -> Vector:
        """Return the pose of a frame, shape (7,), after `pinocchio.forwardKinematics`."""
        placement = pinocchio.updateFramePlacement(self.model, self.data, frame)
        pose = pinocchio.SE3ToXYZQUAT(placement)
        if pose[6] < 0:
            pose[3:] *= -1
        return pose

    def forward(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations caused by torques, including joint resistance."""
        resisted = tau - self.resistance.torques(q, v)
        return pinocchio.aba(self.model, self.data, q, v, resisted)

    def inverse(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return the torques that produce accelerations, including joint resistance."""
        return pinocchio.rnea(self.model, self.data, q, v, a) + self.resistance.torques(q, v)

    def mass(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        matrix = np.triu(pinocchio.crba(self.model, self.data, q))
        return matrix + np.triu(matrix, 1).T

    def jacobian(self, link: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian of a point on a link in the world frame, shape (6, nv)."""
        model, data, frame = self.model, self.data, self.frames[link]
        found = pinocchio.computeFrameJacobian(model, data, q, frame, _WORLD_AXES)
        pinocchio.framesForwardKinematics(model, data, q)
        x, y, z = data.oMf[frame].rotation @ point
        arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        found = np.array(twists_of(found), order="C")
        found[:3] -= arm @ found[3:]
        return found

    def derivatives(self, q: Vector, v: Vector, tau: Vector) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward` w.r.t. positions, velocities, and torques."""
        resisted = tau - self.resistance.torques(q, v)
        found = pinocchio.computeABADerivatives(self.model, self.data, q, v, resisted)
        by_q, by_v, inverse = (np.array(matrix, order="C") for matrix in found)
        inverse = np.triu(inverse) + np.triu(inverse, 1).T
        by_q -= inverse * self.resistance.stiffness
        by_v -= inverse * self.resistance.damping
        return by_q, by_v, inverse

    def forward_batch(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return `forward` for many states, one per row, shape (n, nv)."""
        out = np.zeros((self.model.nv, len(q)), order="F")
        if out.size:
            resisted = tau - self.resistance.torques(q, v)
            columns = [np.ascontiguousarray(rows).T for rows in (q, v, resisted)]
            pinocchio.abaInParallel(1, self._pool, *columns, out)
        return out.T

    def gradients_batch(self, q: Vector, v: Vector, a: Vector, weights: Vector) -> Vector:
        """Return gradients of ``weights @ accelerations`` for many states, shape (3, n, nv).

        With the inverse dynamics torques r(q, v, a) and M their derivative w.r.t. a, they are
        x = weights / M w.r.t. torques, -x dr/dq w.r.t. positions and -x dr/dv w.r.t. velocities.
        The derivatives of the inverse dynamics take two thirds of the time of those of the forward
        dynamics, and yield M as well.
        """
        model, data, resistance = self.model, self.data, self.resistance
        derive, dot = pinocchio.computeRNEADerivatives, np.dot
        decompose, solve = pinocchio.cholesky.decompose, pinocchio.cholesky.solve
        found = np.empty((3, *weights.shape))
        by_q, by_v, by_tau = found
        for q_i, v_i, a_i, given, to_q, to_v, to_tau in zip(
            q, v, a, weights, by_q, by_v, by_tau, strict=True
        ):
            r_by_q, r_by_v, _ = derive(model, data, q_i, v_i, a_i)
            decompose(model, data)
            to_tau[:] = solve(model, data, given)
            dot(to_tau, r_by_q, out=to_q)
            dot(to_tau, r_by_v, out=to_v)
        by_q += by_tau * resistance.stiffness
        by_v += by_tau * resistance.damping
        np.negative(found[:2], out=found[:2])
        return found


class PinocchioAlgorithms(Algorithms):
    """Pinocchio's algorithms for a world; arrays are not validated.

    Create an instance with ``PinocchioAlgorithms.of(world)``. Quaternions in positions must have
    length 1.

    Attributes:
        movables: Algorithms of each robot, then of each moving object.
    """

    def __init__(self, movables: Sequence[MovableAlgorithms], statics: Vector) -> None:
        """Combine movables with static bodies, whose poses have the shape (statics, 7)."""
        self.movables = tuple(movables)
        self._slices: list[tuple[MovableAlgorithms, slice, slice]] = []
        nq = nv = 0
        for each in self.movables:
            ends = nq + each.model.nq, nv + each.model.nv
            self._slices.append((each, slice(nq, ends[0]), slice(nv, ends[1])))
            nq, nv = ends
        self.nq, self.nv = nq, nv
        self._links = [(i, frame) for i, each in enumerate(self.movables) for frame in each.frames]
        self._still = np.zeros((len(statics), 19))
        self._still[:, :7] = statics

    @classmethod
    def of(cls, world: World) -> Self:
        """Return the algorithms of a world."""
        return cls.of_parts(read_parts(world))

    @classmethod
    def of_parts(cls, parts: Parts) -> Self:
        """Return the algorithms of the parts of a world."""
        movables = [MovableAlgorithms.load(each, parts.world.gravity) for each in parts.movables]
        return cls(movables, static_poses(parts))

    def body_poses(self, q: Vector, bodies: Sequence[int]) -> Vector:
        """Return the poses of bodies, given as indices into `Layout.names`, shape (bodies, 7)."""
        found = np.empty((len(bodies), 7))
        known: set[int] = set()
        for row, body in zip(found, bodies, strict=True):
            if body >= len(self._links):
                row[:] = self._still[body - len(self._links), :7]
                continue
            movable, frame = self._links[body]
            each, x, _ = self._slices[movable]
            if movable not in known:
                pinocchio.forwardKinematics(each.model, each.data, q[x])
                known.add(movable)
            row[:] = each.pose(frame)
        return found

    def motions(self, q: Vector, v: Vector, a: Vector, bodies: Sequence[int]) -> Vector:
        """Return the motions of bodies in the world frame, shape (bodies, 19).

        Args:
            q: Positions.
            v: Velocities.
            a: Accelerations.
            bodies: Indices into `Layout.names`.

        Returns:
            One row per body: pose (7), velocity (6), and acceleration (6) of its origin.
        """
        found = np.empty((len(bodies), 19))
        known: set[int] = set()
        for row, body in zip(found, bodies, strict=True):
            if body >= len(self._links):
                row[:] = self._still[body - len(self._links)]
                continue
            movable, frame = self._links[body]
            each, x, y = self._slices[movable]
            if movable not in known:
                pinocchio.forwardKinematics(each.model, each.data, q[x], v[y], a[y])
                known.add(movable)
            each.write_motion(frame, row)
        return found

    def forward_dynamics(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,) in a state."""
        return np.concatenate([x.forward(q[a], v[b], tau[b]) for x, a, b in self._slices])

    def inverse_dynamics(self, q: Vector, v: Vector, acceleration: Vector) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,) in a state."""
        slices = self._slices
        return np.concatenate([x.inverse(q[a], v[b], acceleration[b]) for x, a, b in slices])

    def mass_matrix(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        return self._diagonal([each.mass(q[a]) for each, a, _ in self._slices])

    def jacobian(self, body: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point on a body, given by its index."""
        whole = np.zeros((6, self.nv))
        for each, a, b in self._slices:
            if body < len(each.frames):
                whole[:, b] = each.jacobian(body, q[a], point)
                return whole
            body -= len(each.frames)
        return whole

    def forward_dynamics_derivatives(
        self, q: Vector, v: Vector, tau: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return derivatives of `forward_dynamics` w.r.t. positions, velocities, and torques."""
        found = [each.derivatives(q[a], v[b], tau[b]) for each, a, b in self._slices]
        by_q, by_v, by_tau = (self._diagonal(blocks) for blocks in zip(*found, strict=True))
        return by_q, by_v, by_tau

    def forward_batch(self, q: Vector, v: Vector, tau: Vector, processes: int = 1) -> Vector:
        """Return `forward_dynamics` for many states, shape (n, nv), computed in this process."""
        found = [x.forward_batch(q[:, a], v[:, b], tau[:, b]) for x, a, b in self._slices]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def gradients_batch(
        self, q: Vector, v: Vector, a: Vector, weights: Vector, processes: int = 1
    ) -> Vector:
        """Return gradients of weighted sums of the accelerations, shape (3, n, nv)."""
        found = np.empty((3, *weights.shape))
        for each, i, j in self._slices:
            found[:, :, j] = each.gradients_batch(q[:, i], v[:, j], a[:, j], weights[:, j])
        return found

    def _diagonal(self, blocks: Any) -> Vector:
        """Return a block-diagonal matrix of square blocks."""
        if len(self.movables) == 1:
            return blocks[0]
        whole = np.zeros((self.nv, self.nv))
        begin = 0
        for block in blocks:
            end = begin + len(block)
            whole[begin:end, begin:end] = block
            begin = end
        return whole
