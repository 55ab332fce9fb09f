"""Motor shafts: torque limits, friction, and rotors behind elastic gears.

All arrays have one entry per motor.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_sim.motors.motor import Motor

_SUDDEN = 1e200
"""Slope that stands for a step; finite, because infinity times 0 is NaN."""


def column(motors: Sequence[Motor], option: str) -> Vector:
    """Return an option of all motors, shape (motors,), or (motors, 2) for pairs."""
    return np.array([getattr(motor, option) for motor in motors], np.float64)


class TorqueLimits:
    """Velocity-dependent torque limits of motors."""

    def __init__(self, motors: Sequence[Motor]) -> None:
        self._most = column(motors, "max_torque")
        self._fastest = column(motors, "max_velocity")
        self._slope = np.minimum(column(motors, "slope"), _SUDDEN)
        self.needs_velocity = bool(np.isfinite(self._fastest).any())
        self._acts = self.needs_velocity or bool(np.isfinite(self._most).any())

    def cut(self, commands: Vector, velocities: Vector) -> Vector:
        """Return commands, shape (motors,), limited to the available torque at shaft velocities."""
        if not self._acts:
            return commands
        if not self.needs_velocity:
            return np.minimum(np.maximum(commands, -self._most), self._most)
        forward = self._remaining(self._fastest - velocities)
        backward = self._remaining(self._fastest + velocities)
        return np.minimum(np.maximum(commands, -backward), forward)

    def _remaining(self, margin: Vector) -> Vector:
        """Return the torque available at a given margin, in rad/s, below the velocity limit."""
        with np.errstate(over="ignore"):
            left: Vector = np.minimum(self._slope * np.maximum(margin, 0.0), self._most)
        return left


class Friction:
    """Friction on the shafts of motors with rigid gears."""

    def __init__(self, motors: Sequence[Motor]) -> None:
        rigid = np.array([motor.stiffness is None for motor in motors])[:, None]
        self._viscous = np.where(rigid, column(motors, "viscous"), 0.0).T.copy()
        self._dry = np.where(rigid, column(motors, "dry"), 0.0).T.copy()
        self._velocity = column(motors, "dry_velocity")
        self.acts = bool(self._viscous.any() or self._dry.any())

    def torques(self, velocities: Vector) -> Vector:
        """Return the torques that oppose the shafts' velocities, shape (motors,)."""
        forward = velocities > 0
        viscous = np.where(forward, self._viscous[0], self._viscous[1])
        dry = np.where(forward, self._dry[0], self._dry[1])
        against: Vector = viscous * velocities + dry * np.tanh(velocities / self._velocity)
        return against


class Rotors:
    """Rotors behind elastic gears, as seen from the joints: bodies with one degree of freedom each.

    A rotor is integrated like the joints, with semi-implicit Euler; its friction is implicit, so
    dry friction sticks. A gear with backlash pushes but never pulls.

    Attributes:
        positions: Rotor positions, in rad or m at the joint.
        velocities: Rotor velocities, in rad/s or m/s at the joint.
    """

    def __init__(self, motors: Sequence[Motor], period: float, limits: Vector) -> None:
        """Place the rotors at 0.

        Args:
            motors: The motors with elastic gears.
            period: The physics period, in s.
            limits: Torque limits of the joints, in N m or N, at which the gears slip.
        """
        self._period, self._limits = period, limits
        self._reduction = column(motors, "reduction")
        self._inertia = column(motors, "armature")
        self._stiffness = column(motors, "stiffness")
        self._damping = column(motors, "damping")
        self._half = 0.5 * column(motors, "backlash")
        square = self._reduction**2
        self._viscous = (column(motors, "viscous") * square[:, None]).T.copy()
        self._dry = (column(motors, "dry") * np.abs(self._reduction)[:, None]).T.copy()
        self._has_friction = bool(self._viscous.any() or self._dry.any())
        self.positions, self.velocities = np.zeros(len(motors)), np.zeros(len(motors))
        self._check(motors)

    def _check(self, motors: Sequence[Motor]) -> None:
        pace = (self._period * self._stiffness + 2 * self._damping) * self._period / self._inertia
        for motor, each in zip(motors, pace, strict=True):
            if each >= 4:
                raise ConfigError(
                    f'Motor of "{motor.joint}": its gear is too stiff or too strongly damped for '
                    f"the physics period {self._period:g} s: (stiffness * period² + 2 * damping * "
                    f"period) / (inertia * reduction²) is {each:.3g} but must be below 4."
                )

    def step(self, torques: Vector, positions: Vector, velocities: Vector) -> Vector:
        """Move the rotors by one physics step; return the gears' torques on the joints.

        Args:
            torques: Motor torques as seen from the joints, in N m or N.
            positions: Joint positions, in rad or m.
            velocities: Joint velocities, in rad/s or m/s.
        """
        twist = self.positions - positions
        stretch = twist - np.minimum(np.maximum(twist, -self._half), self._half)
        damped = self._damping * (self.velocities - velocities)
        gear = self._stiffness * stretch + np.where((stretch != 0) | (self._half == 0), damped, 0.0)
        pulls = (gear * stretch < 0) & (self._half > 0)
        gear = np.where(pulls, 0.0, np.minimum(np.maximum(gear, -self._limits), self._limits))
        self.velocities = self.velocities + self._period / self._inertia * (torques - gear)
        if self._has_friction:
            self._apply_friction()
        self.positions = self.positions + self._period * self.velocities
        return gear

    def _apply_friction(self) -> None:
        forward = self.velocities * self._reduction > 0
        share = self._period / self._inertia
        dry = np.where(forward, self._dry[0], self._dry[1])
        slower = 1 + share * np.where(forward, self._viscous[0], self._viscous[1])
        slip = np.maximum(np.abs(self.velocities) - share * dry, 0.0)
        self.velocities = np.sign(self.velocities) * slip / slower
