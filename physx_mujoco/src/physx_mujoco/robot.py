"""A robot or object in MuJoCo: its part of the state of the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from physx_core.rotations import cross_rows, rotate, rotate_back
from physx_core.typing import Index, Vector
from physx_sim import Part
from physx_sim.engines import MovableBody, RobotEngine, twist_change

INWARDS = [0, 1, 2, 6, 3, 4, 5]
"""Order of a floating base's positions in MuJoCo, whose quaternions are w, x, y, z."""


def outwards(pose: Vector) -> Vector:
    """Convert a pose's quaternion from w, x, y, z to x, y, z, w, with w not negative."""
    found: Vector = pose[[0, 1, 2, 4, 5, 6, 3]]
    if found[6] < 0:
        found[3:] *= -1
    return found


@dataclass
class Running:
    """A running world: MuJoCo's model and data, and the state before the last step."""

    model: Any
    data: Any
    positions: Vector
    velocities: Vector


class MujocoRobot(RobotEngine):
    """The part of a world's state that belongs to a robot or object, as views."""

    def __init__(self, movable: MovableBody, part: Part, bodies: Index, running: Running) -> None:
        super().__init__(movable)
        self._running, self._bodies = running, bodies
        self._q, self._v = running.data.qpos[part.positions], running.data.qvel[part.velocities]
        self._earlier = running.positions[part.positions]
        self._before = running.velocities[part.velocities]
        self._torques = running.data.qfrc_applied[part.velocities][self.base :]

    def hold(self, commands: Vector) -> None:
        """Hold commands, shape (joints,), already clipped to their limits."""
        self._torques[:] = commands

    def positions(self) -> Vector:
        """Return the current positions, shape (nq,), as a new vector."""
        q: Vector = self._q.copy()
        if self.base:
            q[:7] = outwards(q[:7])
        return q

    def velocities(self) -> Vector:
        """Return the current velocities, shape (nv,), as a new vector."""
        v: Vector = self._v.copy()
        if self.base:
            v[:3] = rotate_back(self.positions()[3:7].tolist(), *v[:3].tolist())
        return v

    def accelerations(self) -> Vector:
        """Return the velocity change in the last step divided by the period, shape (nv,)."""
        period = self._running.model.opt.timestep
        a: Vector = (self._v - self._before) / period
        if self.base:
            earlier, now = outwards(self._earlier[:7])[3:], outwards(self._q[:7])[3:]
            a[:6] = twist_change(earlier.tolist(), self._before, now.tolist(), self._v, period)
        return a

    def write(self, positions: Vector, velocities: Vector) -> None:
        """Set the state."""
        q, v = positions.copy(), velocities.copy()
        if self.base:
            q[:7] = q[:7][INWARDS]
            v[:3] = rotate(positions[3:7].tolist(), *v[:3].tolist())
        self.set_native(q, v)

    def native(self) -> tuple[Vector, Vector]:
        """Return a copy of MuJoCo's positions and velocities."""
        return self._q.copy(), self._v.copy()

    def set_native(self, positions: Vector, velocities: Vector) -> None:
        """Set a state returned by `native`."""
        self._q[:], self._v[:] = positions, velocities

    def speed(self) -> float:
        """Return the norm of the velocities; NaN or inf if the state is not finite."""
        return float(np.sqrt(self._v.dot(self._v)))

    def can_move(self, link: int) -> bool:
        """Return whether a link, given by its index in the model, can move."""
        return bool(self._running.model.body_weldid[self._bodies[link]])

    def push(self, link: int, force: Vector, torque: Vector, point: Vector, local: bool) -> None:
        """Apply a wrench until `release`."""
        data, body = self._running.data, self._bodies[link]
        mujoco.mj_kinematics(self._running.model, data)
        turn = data.xmat[body].reshape(3, 3)
        if local:
            force, torque = turn @ force, turn @ torque
        arm = data.xpos[body] + turn @ point - data.xipos[body]
        data.xfrc_applied[body] += np.concatenate([force, torque + cross_rows(arm, force)])

    def release(self) -> None:
        """Remove all wrenches."""
        self._running.data.xfrc_applied[self._bodies] = 0.0
