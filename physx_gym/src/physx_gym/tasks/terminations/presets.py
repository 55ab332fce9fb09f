"""Terminations that many robots need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_gym.tasks.quantities import (
    BaseHeight,
    BodiesInContact,
    HighestContactForce,
    JointVelocities,
    LimitDistances,
    Mean,
    MechanicalPower,
    Moment,
    Quantity,
    RollPitch,
    SlipVelocity,
)
from physx_gym.tasks.terminations.termination import OutOfBounds


def roll_pitch(
    low: Sequence[float], high: Sequence[float], name: str = "roll_pitch", **options: Any
) -> OutOfBounds:
    """End the episode when the base rolls or pitches too far: bounds (2,) of each, in rad."""
    return OutOfBounds(RollPitch(), low, high, name, **options)


def base_height(
    lowest: float, over: Sequence[str] = (), name: str = "base_height", **options: Any
) -> OutOfBounds:
    """End the episode when the base is too low, in m, above z = 0 or above the lowest body."""
    return OutOfBounds(BaseHeight(tuple(over)), lowest, None, name, **options)


def lost_ground(
    feet: Sequence[str], highest: float, name: str = "lost_ground", **options: Any
) -> OutOfBounds:
    """End the episode when the lowest of the bodies is too high above z = 0, in m."""
    return OutOfBounds(LowestBody(tuple(feet)), None, highest, name, **options)


def collision(bodies: Sequence[str], name: str = "collision", **options: Any) -> OutOfBounds:
    """End the episode when any two of the bodies touch each other."""
    return OutOfBounds(BodiesInContact(tuple(bodies)), None, 0.5, name, **options)


def high_contact_force(
    bodies: Sequence[str], highest: float, name: str = "high_contact_force", **options: Any
) -> OutOfBounds:
    """End the episode when the contact force on a body is too high, in N."""
    return OutOfBounds(HighestContactForce(tuple(bodies)), None, highest, name, **options)


def slippage(
    bodies: Sequence[str], fastest: float, name: str = "slippage", **options: Any
) -> OutOfBounds:
    """End the episode when a body slides too fast on a contact, in m/s."""
    return OutOfBounds(SlipVelocity(tuple(bodies)), None, fastest, name, **options)


def high_power(highest: float, steps: int, name: str = "high_power", **options: Any) -> OutOfBounds:
    """End the episode when the motors draw too much power, in W, averaged over some steps."""
    return OutOfBounds(Mean(MechanicalPower(), steps), None, highest, name, **options)


def unsafe_joints(
    margin: float, fastest: float, name: str = "unsafe_joints", **options: Any
) -> OutOfBounds:
    """End the episode when a motor's joint moves too fast close to its limits.

    Args:
        margin: Distance that counts as close, in rad or m.
        fastest: Highest velocity there toward or away from the limit, in rad/s or m/s.
        name: Name of the termination.
        options: Options of `Termination`.
    """
    return OutOfBounds(VelocityNearLimits(margin), None, fastest, name, **options)


@dataclass(frozen=True)
class LowestBody(Quantity):
    """Height of the lowest body's origin above z = 0, in m.

    Attributes:
        bodies: Names in the layout.
    """

    bodies: tuple[str, ...]

    def compute(self, moment: Moment) -> float:
        """Return the height."""
        return float(moment.body_poses(self.bodies)[:, 2].min())


@dataclass(frozen=True)
class VelocityNearLimits(Quantity):
    """Velocities of the motors' joints that are close to a limit, otherwise 0, shape (motors,).

    Attributes:
        margin: Distance that counts as close, in rad or m.
    """

    margin: float

    def compute(self, moment: Moment) -> Vector:
        """Return the absolute velocities in rad/s or m/s."""
        near = moment.get(LimitDistances()) < self.margin
        return np.where(near, np.abs(moment.get(JointVelocities())), 0.0)
