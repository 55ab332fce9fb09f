"""MJCF files as MuJoCo itself simulates them, to compare engines of physx with."""

from __future__ import annotations

import mujoco
import numpy as np

from physx_core.rotations import to_matrix
from physx_sim import JointSettings, Robot
from physx_sim.engines import read_robot

LACKING = (
    "dof_frictionloss", "body_gravcomp", "tendon_stiffness", "tendon_damping", "tendon_armature",
    "jnt_stiffnesspoly", "dof_dampingpoly",
)  # fmt: skip
"""What physx names as left out, or, as friction, is not part of the smooth dynamics."""


def states(layout, rng):
    """Return random positions, velocities and torques."""
    q = rng.uniform(-1, 1, layout.nq)
    for part in layout.parts.values():
        if part.floating:
            turn = q[part.positions][3:7]
            turn /= np.linalg.norm(turn)
    return q, *rng.uniform(-1, 1, (2, layout.nv))


class Compiled:
    """A file in MuJoCo itself, without what no engine of physx has."""

    def __init__(self, path, layout):
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.model.opt.density = self.model.opt.viscosity = 0.0
        self.model.opt.gravity[:] = 0.0, 0.0, -9.81
        self.model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        for what in LACKING:
            getattr(self.model, what)[:] = 0.0
        self.data, self.layout = mujoco.MjData(self.model), layout
        at = [self.model.joint(name.rpartition("/")[2]) for name in layout.joints]
        self.q, self.v = ([int(getattr(j, a)[0]) for j in at] for a in ("qposadr", "dofadr"))
        bases = [j for j in range(self.model.njnt) if self.model.jnt_type[j] == 0]
        self.bases = [(self.model.jnt_qposadr[j], self.model.jnt_dofadr[j]) for j in bases]
        self.floating = [part for part in layout.parts.values() if part.floating]

    def set(self, q, v, tau):
        data, layout = self.data, self.layout
        data.qpos[self.q] = q[list(layout.position_index.values())]
        ours = list(layout.velocity_index.values())
        data.qvel[self.v], data.qfrc_applied[self.v] = v[ours], tau[ours]
        for (x, y), part in zip(self.bases, self.floating, strict=True):
            pose, twist, wrench = q[part.positions], v[part.velocities], tau[part.velocities]
            turn = to_matrix(pose[3:7])
            data.qpos[x : x + 7] = pose[[0, 1, 2, 6, 3, 4, 5]]
            data.qvel[y : y + 6] = *(turn @ twist[:3]), *twist[3:6]
            data.qfrc_applied[y : y + 6] = *(turn @ wrench[:3]), *wrench[3:6]
        mujoco.mj_forward(self.model, data)

    def accelerations(self, q, v, tau):
        """Return what physx's forward dynamics is."""
        self.set(q, v, tau)
        found = np.zeros(self.layout.nv)
        found[list(self.layout.velocity_index.values())] = self.data.qacc_smooth[self.v]
        for (_, y), part in zip(self.bases, self.floating, strict=True):
            a, twist = self.data.qacc_smooth[y : y + 6], v[part.velocities]
            linear = a[:3] @ to_matrix(q[part.positions][3:7]) - np.cross(twist[3:6], twist[:3])
            found[part.velocities][:6] = *linear, *a[3:]
        return found

    def masses(self):
        """Return the mass matrix of the joints, after `set`."""
        found = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, found)
        return found[np.ix_(self.v, self.v)]

    def poses(self, names):
        """Return the poses of bodies, with quaternions x, y, z, w, after `set`."""
        found = []
        for name in names:
            body = self.data.body(name)
            w, *xyz = body.xquat * (1 if body.xquat[0] >= 0 else -1)
            found.append([*body.xpos, *xyz, w])
        return np.array(found)


def without_friction(robots):
    """Return robots without friction in their joints, which MuJoCo's smooth dynamics lack."""
    found = []
    for robot in robots:
        names = [joint.name for joint in read_robot(robot).joints]
        joints = {name: JointSettings(friction=0.0) for name in names}
        found.append(Robot(**{**vars(robot), "joints": joints}))
    return found
