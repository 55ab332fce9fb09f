"""Servos, imposed velocities, and velocity limits, which MuJoCo does not have.

A step is repeated with adjusted torques until it ends with the desired velocities.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
        step: Simulates a physics step.
    """

    def __init__(
        self, parts: Parts, layout: Layout, running: Running, step: Callable[[], None]
    ) -> None:
        self._running, self._step, modes = running, step, np.array(layout.modes)
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
        self._rows = np.concatenate(rows)
        self._fastest = np.where(self._driven, np.inf, fastest)
        self._strongest = np.where(modes == "velocity", np.inf, layout.max_torque)
        self.idle = not (self._driven.any() or np.isfinite(self._fastest).any())

    def step(self) -> None:
        """Simulate a physics step; for driven joints, the applied force is the desired velocity."""
        running, at, driven = self._running, self._places, self._driven
        model, data = running.model, running.data
        q, v = running.positions, running.velocities
        q[:], v[:], warm = data.qpos, data.qvel, data.qacc_warmstart.copy()
        wanted, torques = data.qfrc_applied[at].copy(), np.zeros(len(at))
        response, tried, before = None, torques, v[at]
        for _ in range(_MOST):
            data.qfrc_applied[at] = np.where(driven, 0.0, wanted) + torques
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = q, v, warm
            self._step()
            now = data.qvel[at]
            side = -np.copysign(1.0, np.where(torques, torques, -now))  # of a limit
            active = driven | (side * now > self._fastest) | (torques != 0)
            goal = np.where(driven, wanted, np.where(active, side * self._fastest, now))
            low = np.where(driven, -self._strongest, np.where(side > 0, -np.inf, 0.0))
            high = np.where(driven, self._strongest, np.where(side > 0, 0.0, np.inf))
            error = goal - now
            stuck = ((torques <= low) & (error < 0)) | ((torques >= high) & (error > 0))
            free = np.flatnonzero(active & ~stuck)
            if not (np.abs(error[free]) > _EXACT * (1 + np.abs(now[free]))).any():
                break
            if response is None:
                response = model.opt.timestep * self._inverse()
            elif (change := torques - tried).any():  # contacts resist, too: Broyden's method
                missed = now - before - response @ change
                response += np.outer(missed, change / change.dot(change))
            more = _solved(response[np.ix_(free, free)], error[free])
            tried, before = torques.copy(), now
            torques[free] = np.clip(torques[free] + more, low[free], high[free])
        data.qfrc_applied[at] = wanted

    def _inverse(self) -> Vector:
        """Return the inverse of the mass matrix with implicit damping, shape (joints, joints)."""
        model, period = self._running.model, self._running.model.opt.timestep
        mass = np.diag(period * model.dof_damping)
        mass += np.diag(period**2 * model.jnt_stiffness[model.dof_jntid])
        mass[np.ix_(self._places, self._places)] += _STIFF * self._rows.T @ self._rows
        plain = np.zeros_like(mass)
        mujoco.mj_fullM(model, self._running.data, plain)
        found: Vector = np.linalg.inv(plain + mass)[np.ix_(self._places, self._places)]
        return found


def _solved(response: Vector, error: Vector) -> Vector:
    """Return the torques of joints that correct their velocities, the least if some cannot."""
    found: Any
    try:
        found = np.linalg.solve(response, error)
    except np.linalg.LinAlgError:  # something holds joints, whatever their torques are
        found = np.linalg.lstsq(response, error, rcond=None)[0]
    return np.asarray(found, np.float64)
