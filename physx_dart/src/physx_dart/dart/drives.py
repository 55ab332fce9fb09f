"""Drives: rotors, couplings of joints, and servos that leave a limit, which DART lacks.

Each is written as torques and settings before a physics step. DART's solver for contacts, limits
and servos knows nothing of them, so what its impulses change there is corrected in the next step.
(DART has mimic joints. Its coupler diverges if a follower moves further than its leader, and if the
leader is a servo.)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_sim.engines import RobotModel

_FASTEST_RETURN = 10.0
"""Maximum speed, in rad/s or m/s, at which joints return to where their couplings hold."""
_NEAR = 1e-6
"""Distance from a limit, in rad or m, within which a servo is at it."""
_SERVOS = ("servo", "position")


class Drives:
    """Torques and settings of a robot's joints that are written before each step.

    Args:
        model: The robot.
        skeleton: It in DART.
        period: Length of a step, in s.
    """

    def __init__(self, model: RobotModel, skeleton: Any, period: float) -> None:
        self._skeleton, self._period = skeleton, period
        joints, nodes = model.joints, list(skeleton.getBodyNodes())
        moving = [i for i, body in enumerate(model.bodies) if body.joint is not None]
        self._natives = [nodes[i].getParentJoint() for i in moving]
        self._bodies = [nodes[i] for i in moving]
        self._base = int(skeleton.getNumDofs()) - len(joints)
        armature = np.array([joint.armature for joint in joints])
        # Implicit damping of I / h, and the opposite torque, are an inertia of I.
        self._rotors = armature / period
        self._rows, self._sums = model.coupling_rows
        self._forces = np.array([joint.mode == "force" for joint in joints], np.bool_)
        lower, upper = np.array([(joint.lower, joint.upper) for joint in joints]).reshape(-1, 2).T
        self._lower, self._upper = lower, upper
        imposed = np.array([joint.mode == "velocity" for joint in joints], np.bool_)
        self._dynamic = np.flatnonzero(~np.concatenate([np.zeros(self._base, np.bool_), imposed]))
        servos = np.array([joint.mode in _SERVOS for joint in joints], np.bool_)
        self._servos = np.flatnonzero(servos & (np.isfinite(lower) | np.isfinite(upper)))
        self._loose: set[int] = set()
        self.torques = bool(armature.any() or len(self._rows))
        self.acts = self.torques or len(self._servos) > 0
        self.outer = self.torques and not self._forces.all()
        for native, joint, rotor in zip(self._natives, joints, self._rotors, strict=True):
            if rotor:
                native.setDampingCoefficient(0, joint.damping + rotor)
            if self.torques and joint.mode == "force":  # commands are within the limits already
                native.setForceLowerLimit(0, -np.inf)
                native.setForceUpperLimit(0, np.inf)

    def write(self, commands: Vector) -> None:
        """Write the torques and settings for a step, after all wrenches.

        Args:
            commands: The held commands of the joints, shape (joints,).
        """
        skeleton, base = self._skeleton, self._base
        v = skeleton.getVelocities()
        if len(self._servos):
            self._loosen(skeleton.getPositions()[base:], v[base:], commands)
        if not self.torques:
            return
        torques = self._rotors * v[base:]
        self._apply(commands, torques, torques)
        if not len(self._rows):
            return
        skeleton.computeForwardDynamics()
        free = (v + self._period * skeleton.getAccelerations())[base:]
        gaps = self._rows @ skeleton.getPositions()[base:] - self._sums
        aims = np.clip(-gaps / self._period, -_FASTEST_RETURN, _FASTEST_RETURN)
        at = self._dynamic
        rows = np.concatenate([np.zeros((len(gaps), base)), self._rows], axis=1)[:, at]
        spread = np.linalg.solve(skeleton.getAugMassMatrix()[np.ix_(at, at)], rows.T)
        change = np.linalg.solve(rows @ spread, aims - self._rows @ free)
        more = self._rows.T @ change / self._period
        self._apply(commands, torques + more, more)

    def _apply(self, commands: Vector, torques: Vector, more: Vector) -> None:
        """Set the torques of joints that take them, and add to those of all others."""
        held = np.concatenate([np.zeros(self._base), commands + np.where(self._forces, torques, 0)])
        self._skeleton.setCommands(held)
        for joint in np.flatnonzero(~self._forces & (more != 0)):
            self._turn(self._bodies[joint], self._natives[joint], float(more[joint]))

    def _turn(self, body: Any, native: Any, torque: float) -> None:
        """Apply a torque or force of a joint to its two bodies."""
        pose, parent = body.getWorldTransform().matrix(), body.getParentBodyNode()
        axis = torque * (pose[:3, :3] @ native.getAxis())
        if native.getType() == "RevoluteJoint":
            body.addExtTorque(axis, False)
            parent.addExtTorque(-axis, False)
            return
        there = np.linalg.inv(parent.getWorldTransform().matrix()) @ pose[:, 3]
        body.addExtForce(axis, np.zeros(3), False, True)
        parent.addExtForce(-axis, there[:3], False, True)

    def _loosen(self, q: Vector, v: Vector, commands: Vector) -> None:
        """Do not enforce a limit that a servo is about to leave: in DART it would stay there."""
        for joint in self._servos.tolist():
            high = q[joint] > self._upper[joint] - _NEAR and commands[joint] < 0 and v[joint] <= 0
            low = q[joint] < self._lower[joint] + _NEAR and commands[joint] > 0 and v[joint] >= 0
            leaves = bool(high or low)
            if leaves != (joint in self._loose):
                self._loose ^= {joint}
                self._natives[joint].setLimitEnforcement(not leaves)

    def forget(self) -> None:
        """Enforce all limits again, so that the state alone determines what follows."""
        for joint in self._loose:
            self._natives[joint].setLimitEnforcement(True)
        self._loose.clear()
