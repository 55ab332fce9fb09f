"""Contacts of which MuJoCo knows too little.

These are contacts with bodies that move as prescribed, deep ones, and those in which one body has
the smaller friction and the other one resists turning. A step is split where MuJoCo has found the
contacts but not yet solved for their forces.
"""

from __future__ import annotations

import mujoco
import numpy as np

from physx_core.rotations import cross_rows, to_matrix
from physx_core.typing import Vector
from physx_mujoco.model import LAG, WorldModel

_FASTEST_RETURN = 0.1
"""Maximum speed, in m/s, at which contacts are pushed out: otherwise deep ones would jump."""


class ContactRows:
    """Steps in which static bodies push and drag, and deep contacts do not jump.

    Args:
        world: The world.
        data: Its state.
    """

    def __init__(self, world: WorldModel, data: mujoco.MjData) -> None:
        self._world, self._data = world, data
        self._moving: dict[int, Vector] = {}
        self.expect_depth()
        self.note_frictions()

    @property
    def active(self) -> bool:
        """Whether steps differ from MuJoCo's own."""
        return self._deep or self._mixed or bool(self._moving)

    def expect_depth(self) -> None:
        """Note that a state was set, in which contacts may be deep."""
        # With this integrator there are none, and its steps cannot be split.
        self._deep = self._world.model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4

    def note_frictions(self) -> None:
        """Note whether MuJoCo's choice of torsional and rolling friction is the wrong one."""
        model = self._world.model
        turns = bool(model.geom_friction[:, 1:].any())
        self._mixed = turns and len(set(model.geom_priority.tolist())) > 1

    def place(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body for the next step, as in `RobotSimulation.place_static`."""
        model, data, body = self._world.model, self._data, self._world.statics[static]
        if (mocap := model.body_mocapid[body]) >= 0:
            data.mocap_pos[mocap], data.mocap_quat[mocap] = pose[:3], pose[[6, 3, 4, 5]]
        turn = to_matrix(pose[3:])
        # What drags is MuJoCo's velocity of surfaces, in the frame of each shape.
        for shape in (model.geom_bodyid == body).nonzero()[0].tolist():
            own = np.zeros(9)
            mujoco.mju_quat2Mat(own, model.geom_quat[shape])
            whole, arm = turn @ own.reshape(3, 3), turn @ model.geom_pos[shape]
            linear = velocity[:3] + cross_rows(velocity[3:], arm) + turn @ surface
            model.geom_surfacevel[shape] = *(linear @ whole), *(velocity[3:] @ whole)
        model.flg_surfacevel = bool(model.geom_surfacevel.any())
        self._moving.pop(int(body), None)
        if velocity.any():
            self._moving[int(body)] = np.concatenate([pose[:3], velocity])

    def step(self) -> None:
        """Simulate a physics step."""
        model, data = self._world.model, self._data
        if not self.active:
            mujoco.mj_step(model, data)
            return
        self.begin()
        mujoco.mj_step2(model, data)

    def begin(self) -> None:
        """Begin a physics step, up to the forces, which `mujoco.mj_step2` solves for."""
        data = self._data
        mujoco.mj_step1(self._world.model, data)
        if self._mixed and data.ncon:
            self._resist_turning()
        if self._deep:
            self._limit_depth()
        if self._moving:
            self._push()

    def _resist_turning(self) -> None:
        """Give each contact the larger torsional and rolling friction of its two shapes."""
        model, data = self._world.model, self._data
        turning = model.geom_friction[data.contact.geom, 1:].max(axis=1)
        data.contact.friction[:, 2:] = np.maximum(turning[:, [0, 1, 1]], mujoco.mjMINMU)
        for remake in (
            mujoco.mj_makeConstraint,
            mujoco.mj_island,
            mujoco.mj_projectConstraint,
            mujoco.mj_referenceConstraint,
        ):
            remake(model, data)

    def _limit_depth(self) -> None:
        """Let contacts appear only so deep as they may return."""
        most = _FASTEST_RETURN * (LAG - 1) * self._world.model.opt.timestep
        contact, data = self._data.contact, self._data
        rows = contact.efc_address[(contact.dist < -most) & (contact.efc_address >= 0)]
        data.efc_pos[rows] = -most
        self._deep = len(rows) > 0

    def _push(self) -> None:
        """Let contacts know the speeds at which moving bodies approach.

        MuJoCo adds the gap, in the unit of a velocity, to the speed at which it closes, so a speed
        that it does not know is told as a part of the gap, with the motion within the step.
        """
        model, data, contact = self._world.model, self._data, self._data.contact
        bodies = model.geom_bodyid[contact.geom].reshape(-1, 2)
        for number, row in enumerate(contact.efc_address.tolist()):
            for side, body in enumerate(bodies[number].tolist()):
                if row < 0 or body not in self._moving:
                    continue
                center, linear, angular = np.split(self._moving[body], 3)
                moved = linear + cross_rows(angular, contact.pos[number] - center)
                speed = float(moved @ contact.frame[number, :3]) * (1.0 if side else -1.0)
                data.efc_pos[row] += speed * LAG * model.opt.timestep
