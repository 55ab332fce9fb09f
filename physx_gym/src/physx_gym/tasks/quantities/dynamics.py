"""Center of mass, momentum and power."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from physx_core.errors import ConfigError
from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_gym.tasks.quantities.bodies import BodyPositions
from physx_gym.tasks.quantities.combined import Rate
from physx_gym.tasks.quantities.joints import JointTorques, JointVelocities
from physx_gym.tasks.quantities.quantity import Moment, Quantity
from physx_sim.errors import FeatureNotSupportedError


@dataclass(frozen=True)
class MassAndMomentum(Quantity):
    """Mass and momentum of a robot whose base floats, shape (10,), from its mass matrix.

    Mass in kg; center of mass in m, in the world; linear momentum in kg m/s and angular momentum
    about the center of mass in kg m²/s, both along the world's axes.
    The first six rows of the mass matrix are the spatial inertia of the whole robot about its base
    (Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 9.3).
    """

    def compute(self, moment: Moment) -> Vector:
        """Return mass, center of mass and momentum.

        Raises:
            FeatureNotSupportedError: If the base is fixed.
        """
        if not moment.robot.floating:
            raise FeatureNotSupportedError(
                "A robot with a fixed base", "a center of mass", (), "Its base must float."
            )
        rows = moment.mass_matrix()[:6]
        mass = float(rows[0, 0])
        center = np.array([rows[5, 1], rows[3, 2], rows[4, 0]]) / mass
        momentum = rows @ moment.v
        linear = momentum[:3]
        angular = momentum[3:] - np.cross(center, linear)
        turn = to_matrix(moment.q[3:7])
        return np.concatenate([[mass], moment.q[:3] + turn @ center, turn @ linear, turn @ angular])


@dataclass(frozen=True)
class CenterOfMass(Quantity):
    """Center of mass of a robot whose base floats, in the world, shape (3,), in m."""

    def compute(self, moment: Moment) -> Vector:
        """Return the position."""
        return np.asarray(moment.get(MassAndMomentum())[1:4])


@dataclass(frozen=True)
class CenterOfMassVelocity(Quantity):
    """Velocity of the center of mass along the world's axes, shape (3,), in m/s."""

    def compute(self, moment: Moment) -> Vector:
        """Return the velocity."""
        found = moment.get(MassAndMomentum())
        return np.asarray(found[4:7] / found[0])


@dataclass(frozen=True)
class Momentum(Quantity):
    """Momentum along the world's axes, shape (6,).

    Linear in kg m/s, then angular about the center of mass in kg m²/s.
    """

    def compute(self, moment: Moment) -> Vector:
        """Return the momentum."""
        return np.asarray(moment.get(MassAndMomentum())[4:10])


@dataclass(frozen=True)
class CapturePoint(Quantity):
    """Point on the ground where the robot would have to step to come to rest, shape (2,), in m.

    That of the linear inverted pendulum: position of the center of mass plus its velocity divided
    by sqrt(gravity / height) (Pratt et al., "Capture Point", 2006).

    Attributes:
        feet: Bodies it stands on: the height is above the lowest of them; none: above z = 0.
    """

    feet: tuple[str, ...] = ()

    def compute(self, moment: Moment) -> Vector:
        """Return the point."""
        center, velocity = moment.get(CenterOfMass()), moment.get(CenterOfMassVelocity())
        ground = moment.get(BodyPositions(self.feet))[:, 2].min() if self.feet else 0.0
        pace = math.sqrt(max(float(center[2] - ground), 0.0) / _gravity(moment))
        return np.asarray(center[:2] + velocity[:2] * pace)


@dataclass(frozen=True)
class ZeroMomentPoint(Quantity):
    """Point on z = 0 at which the total ground reaction force acts, shape (2,), in m.

    Computed from the change in momentum over the last step; below the center of mass if the ground
    carries no load.
    """

    def compute(self, moment: Moment) -> Vector:
        """Return the point."""
        found = moment.get(MassAndMomentum())
        mass, center = found[0], found[1:4]
        force_x, force_y, force_z, turn_x, turn_y, _ = moment.get(Rate(Momentum())).tolist()
        carried = force_z + mass * _gravity(moment)
        if carried <= 1e-6 * mass * _gravity(moment):
            return np.asarray(center[:2].copy())
        height = float(center[2])
        x = center[0] - (height * force_x + turn_y) / carried
        y = center[1] - (height * force_y - turn_x) / carried
        return np.array([x, y])


@dataclass(frozen=True)
class MechanicalPower(Quantity):
    """Power consumed by the motors, in W.

    Attributes:
        braking: Use of braking power. ``"regained"``: all of it is regained; ``"lost"``: all of it
            is lost; ``"shared"``: other motors use it, the rest is lost; ``"penalized"``: braking
            costs as much as driving.

    Raises:
        ConfigError: If `braking` is none of these.
    """

    braking: Literal["regained", "lost", "shared", "penalized"] = "lost"

    def __post_init__(self) -> None:
        """Check the option."""
        super().__post_init__()
        if self.braking not in ("regained", "lost", "shared", "penalized"):
            raise ConfigError(
                f'MechanicalPower.braking is "{self.braking}" but must be "regained", "lost", '
                '"shared" or "penalized".'
            )

    def compute(self, moment: Moment) -> float:
        """Return the power."""
        power = moment.get(JointTorques()) * moment.get(JointVelocities())
        if self.braking == "regained":
            return float(power.sum())
        if self.braking == "shared":
            return max(float(power.sum()), 0.0)
        if self.braking == "penalized":
            return float(np.abs(power).sum())
        return float(np.maximum(power, 0.0).sum())


def _gravity(moment: Moment) -> float:
    return float(np.linalg.norm(moment.simulator.world.gravity))
