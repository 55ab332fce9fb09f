"""Servos, imposed velocities, and velocity limits, which MuJoCo does not have.

The forces of a step are solved for again, with adjusted torques, until it ends with the desired
velocities.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from physx_core.typing import Vector
from physx_mujoco.robot import Running
from physx_sim import Layout
from physx_sim.engines import Parts

_STIFF = 1e6
"""Inertia, in kg m² or kg, with which coupled joints move together."""
_MOST, _EXACT = 30, 1e-10
"""Maximum repetitions of a step, and the relative velocity error at which they end."""


class Drives:
    """The joints whose velocities are controlled or limited; `idle` if there are none.

    Args:
        parts: The world; the velocity limit of a joint that follows another limits its leader.
        layout: Its joints.
        running: The world.
        begin: Begins a physics step, which `mujoco.mj_step2` ends.
    """

    def __init__(
        self, parts: Parts, layout: Layout, running: Running, begin: Callable[[], None]
    ) -> None:
        self._running, self._begin, modes = running, begin, np.array(layout.modes)
        self._driven = modes != "force"
        self._places = np.array(list(layout.velocity_index.values()), np.intp)
        fastest = layout.max_velocity.copy()
        rows = [np.zeros((0, len(fastest)))]
        for movable, part in zip(parts.movables, layout.parts.values(), strict=True):
            own = fastest[part.joints]
            for follower, leader, mimic in movable.model.followers:
                own[leader] = min(own[leader], own[follower] / abs(mimic.multiplier))
                own[follower] = np.inf
            coupled = movable.model.coupling_rows[0]
            rows.append(np.zeros((len(coupled), len(fastest))))
            rows[-1][:, part.joints] = coupled
        fastest[self._driven] = np.inf
        strongest = np.where(modes == "velocity", np.inf, layout.max_torque)
        self.idle = not (self._driven.any() or np.isfinite(fastest).any())
        # Lists, because operations on short arrays take longer.
        bounds = self._driven.tolist(), fastest.tolist(), strongest.tolist()
        self._joints = list(zip(*bounds, strict=True))
        model, joined, period = running.model, np.concatenate(rows), running.model.opt.timestep
        self._resistance = np.diag(
            period * model.dof_damping + period**2 * model.jnt_stiffness[model.dof_jntid]
        )
        self._resistance[np.ix_(self._places, self._places)] += _STIFF * joined.T @ joined

    def step(self) -> None:
        """Simulate a physics step; for driven joints, the applied force is the desired velocity."""
        running, at = self._running, self._places
        model, data = running.model, running.data
        q, v, warmth, forces = data.qpos, data.qvel, data.qacc_warmstart, data.qfrc_applied
        start = running.positions, running.velocities, warmth.copy()
        start[0][:], start[1][:] = q, v
        wanted, response = forces.take(at), np.zeros(0)
        applied, targets = np.where(self._driven, 0.0, wanted), wanted.tolist()
        torques = tried = before = np.zeros(len(at))
        self._begin()
        for count in range(_MOST):
            forces[at] = applied + torques
            q[:], v[:], warmth[:] = start
            mujoco.mj_step2(model, data)
            now = v.take(at)
            free, errors, least, most = self._off(now.tolist(), torques.tolist(), targets)
            if not free:
                break
            if not count:
                response = model.opt.timestep * self._inverse()
            elif (change := torques - tried).any():  # contacts resist, too: Broyden's method
                missed = now - before - response @ change
                response += missed[:, None] * (change / change.dot(change))
            more = _solved(response.take(free, 0).take(free, 1), errors)
            tried, before, torques = torques, now, torques.copy()
            torques[free] = np.minimum(np.maximum(torques[free] + more, least), most)
        forces[at] = wanted

    def _off(
        self, speeds: Sequence[float], torques: Sequence[float], targets: Sequence[float]
    ) -> tuple[list[int], list[float], list[float], list[float]]:
        """Return the joints whose velocities can be improved; none if all are exact.

        Args:
            speeds: Velocities of all joints after the step.
            torques: What was added to the torques.
            targets: Desired velocities of driven joints.

        Returns:
            The joints, their errors, and the smallest and largest torques that may be added.
        """
        free, exact = [], True
        for joint, (driven, fastest, strongest) in enumerate(self._joints):
            speed, torque = speeds[joint], torques[joint]
            if driven:
                goal, least, most = targets[joint], -strongest, strongest
            elif torque > 0 or (not torque and speed < -fastest):
                goal, least, most = -fastest, 0.0, math.inf
            elif torque < 0 or speed > fastest:
                goal, least, most = fastest, -math.inf, 0.0
            else:
                continue
            error = goal - speed
            if not ((torque <= least and error < 0) or (torque >= most and error > 0)):
                free.append((joint, error, least, most))
                exact = exact and not abs(error) > _EXACT * (1 + abs(speed))
        if exact:
            return [], [], [], []
        joints, errors, least, most = map(list, zip(*free, strict=True))
        return joints, errors, least, most

    def _inverse(self) -> Vector:
        """Return the inverse of the mass matrix with implicit damping, shape (joints, joints)."""
        mass = np.zeros_like(self._resistance)
        mujoco.mj_fullM(self._running.model, self._running.data, mass)
        found: Vector = np.linalg.inv(mass + self._resistance)[np.ix_(self._places, self._places)]
        return found


def _solved(response: Vector, error: Sequence[float]) -> Vector:
    """Return the torques of joints that correct their velocities, the least if some cannot."""
    wanted = np.array(error)
    try:
        found: Vector = np.linalg.solve(response, wanted)
    except np.linalg.LinAlgError:  # something holds joints, whatever their torques are
        found = np.linalg.lstsq(response, wanted, rcond=None)[0]
    return found
