"""MuJoCo's algorithms for a world in any state.

Its velocities differ from those of physx for floating bases: their linear part is expressed in the
world frame, not in the base frame.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from physx_core.rotations import cross, to_matrix
from physx_core.typing import Vector
from physx_mujoco.model import WorldModel
from physx_mujoco.robot import INWARDS, outwards
from physx_sim.engines import (
    Algorithms,
    Parts,
    Resistance,
    base_accelerations,
    layout_of,
    static_poses,
)


class MujocoAlgorithms(Algorithms):
    """MuJoCo's kinematics and dynamics of a world, without contacts and limits."""

    def __init__(self, parts: Parts, world: WorldModel) -> None:
        layout = layout_of(parts)
        self.nq, self.nv = layout.nq, layout.nv
        self._model, self._bodies = world.model, world.bodies
        self._data, self._statics = mujoco.MjData(world.model), static_poses(parts)
        places = list(layout.parts.values())
        bases = [place for place in places if place.floating]
        self._bases = [(place.positions.start, place.velocities.start) for place in bases]
        tables = [Resistance.of(movable).table for movable in parts.movables]
        self._resistance = Resistance(np.concatenate(tables, axis=1))
        ends = [np.arange(p.positions.stop - p.nv, p.positions.stop) for p in places]
        self._stretched = np.concatenate(ends).astype(np.intp)

    def body_poses(self, q: Vector, bodies: Sequence[int]) -> Vector:
        """Return the poses of bodies, given as indices into `Layout.names`, shape (bodies, 7)."""
        self._place(q)
        return np.array([self._pose(body) for body in bodies]).reshape(-1, 7)

    def motions(self, q: Vector, v: Vector, a: Vector, bodies: Sequence[int]) -> Vector:
        """Return the motions of bodies in the world frame, shape (bodies, 19)."""
        self._move(q, v, a)
        found, six = np.zeros((len(bodies), 19)), np.zeros(6)
        model, data, kind = self._model, self._data, mujoco.mjtObj.mjOBJ_XBODY
        for row, body in zip(found, bodies, strict=True):
            row[:7] = self._pose(body)
            if body < len(self._bodies):
                mujoco.mj_objectVelocity(model, data, kind, self._bodies[body], six, 0)
                row[7:10], row[10:13] = six[3:], six[:3]
                mujoco.mj_objectAcceleration(model, data, kind, self._bodies[body], six, 0)
                row[13:16], row[16:19] = six[3:] + model.opt.gravity, six[:3]
        return found

    def forward_dynamics(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,) and resistance."""
        self._move(q, v)
        bias, resisted = np.zeros(self.nv), tau - self._resistance.torques(q[self._stretched], v)
        mujoco.mj_rne(self._model, self._data, 0, bias)
        mass = self._mass()
        scale = 1 / np.sqrt(np.diag(mass))
        torques = scale * (self._turned(q, resisted, inwards=True) - bias)
        a: Vector = scale * np.linalg.solve(scale * mass * scale[:, None], torques)
        for x, y in self._bases:
            orientation, linear = q[x + 3 : x + 7].tolist(), a[y : y + 3].tolist()
            a[y : y + 3] = base_accelerations(orientation, linear, v[y : y + 6])
        return a

    def inverse_dynamics(self, q: Vector, v: Vector, acceleration: Vector) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,) against resistance."""
        model, data, tau = self._model, self._data, np.zeros(self.nv)
        self._move(q, v, acceleration)
        mujoco.mj_rne(model, data, 1, tau)
        tau += model.dof_armature * data.qacc
        found: Vector = self._turned(q, tau) + self._resistance.torques(q[self._stretched], v)
        return found

    def mass_matrix(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        self._place(q)
        return self._turned(q, self._turned(q, self._mass()).T.copy())

    def jacobian(self, body: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point on a body, given by its index."""
        found, data = np.zeros((6, self.nv)), self._data
        if body < len(self._bodies):
            self._place(q)
            place = self._bodies[body]
            at = data.xpos[place] + data.xmat[place].reshape(3, 3) @ point
            mujoco.mj_jac(self._model, data, found[:3], found[3:], at, place)
        return self._turned(q, found)

    def _mass(self) -> Vector:
        """Return the mass matrix in MuJoCo's convention, as a sum over the bodies, after `_place`.

        MuJoCo computes its own matrix about the center of mass of the whole robot, where the
        inertia of a small part is lost to rounding.
        """
        model, data, found = self._model, self._data, np.diag(self._model.dof_armature)
        linear, angular = np.zeros((2, 3, self.nv))
        for body in self._bodies:
            mujoco.mj_jacBodyCom(model, data, linear, angular, body)
            turning = data.ximat[body].reshape(3, 3).T @ angular
            found += model.body_mass[body] * linear.T @ linear
            found += turning.T @ (model.body_inertia[body][:, None] * turning)
        return found

    def _place(self, q: Vector) -> None:
        """Place the bodies."""
        data = self._data
        data.qpos[:] = q
        for x, _ in self._bases:
            data.qpos[x : x + 7] = q[x : x + 7][INWARDS]
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)

    def _move(self, q: Vector, v: Vector, a: Vector | None = None) -> None:
        """Place the bodies, and compute their motion for velocities and accelerations."""
        model, data = self._model, self._data
        self._place(q)
        data.qvel[:] = self._turned(q, v.copy(), inwards=True)
        mujoco.mj_comVel(model, data)
        if a is not None:
            a = a.copy()
            for _, y in self._bases:
                a[y : y + 3] += cross(*v[y + 3 : y + 6].tolist(), *v[y : y + 3].tolist())
            data.qacc[:] = self._turned(q, a, inwards=True)
            mujoco.mj_rnePostConstraint(model, data)

    def _pose(self, body: int) -> Vector:
        if body >= len(self._bodies):
            return np.array(self._statics[body - len(self._bodies)])
        place, data = self._bodies[body], self._data
        return outwards(np.concatenate([data.xpos[place], data.xquat[place]]))

    def _turned(self, q: Vector, rows: Vector, *, inwards: bool = False) -> Vector:
        """Rotate the bases' linear parts of rows to the base frame; `inwards`: to the world's."""
        for x, y in self._bases:
            turn = to_matrix(q[x + 3 : x + 7])
            rows[..., y : y + 3] = rows[..., y : y + 3] @ (turn.T if inwards else turn)
        return rows
