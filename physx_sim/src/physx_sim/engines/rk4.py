"""The classic fourth-order Runge-Kutta method, for robots without constraints."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np

from physx_core.typing import Vector
from physx_sim.engines.models.parts import Parts
from physx_sim.errors import FeatureNotSupportedError

RK4_LACKS = (
    "actuators",
    "attachments",
    "contacts",
    "body_contacts",
    "couplings",
    "isotropic_friction",
    "joint_friction",
    "limits",
    "mimic",
    "moving_statics",
    "restitution",
    "rolling",
    "self_collisions",
    "step_derivatives",
    "torsional_friction",
)
"""Features that a simulation lacks with this integrator."""


def check_rk4(parts: Parts, engine: str, features: Collection[str]) -> None:
    """Raise an error if a world needs constraints.

    Raises:
        FeatureNotSupportedError: If there may be contacts, attachments, couplings, wheels, or a
            joint has limits, friction, a leader, or a mode other than ``"force"``.
    """
    advice = 'Use World(integrator="euler").'
    solid = sum(bool(movable.model.shapes) for movable in parts.movables) + len(parts.statics)
    if parts.world.contacts != "none" and solid > 1:
        raise FeatureNotSupportedError(engine, "contacts in rk4", features, advice)
    for what, needed in (
        ("attachments", bool(parts.attachments)),
        ("couplings", any(movable.model.couplings for movable in parts.movables)),
        ("rolling", parts.rolling),
    ):
        if needed:
            raise FeatureNotSupportedError(engine, f"{what} in rk4", features, advice)
    for joint in (joint for movable in parts.movables for joint in movable.model.joints):
        limits = [joint.lower, joint.upper, joint.max_velocity]
        for name, asked in (
            ("limits", np.isfinite(limits).any()),
            ("joint_friction", joint.friction > 0),
            ("mimic", joint.mimic is not None),
            ("actuators", joint.mode != "force"),
        ):
            if asked:
                what = f'{name} in rk4, of the joint "{joint.name}"'
                raise FeatureNotSupportedError(engine, what, features, advice)


def rk4_step(
    q: Vector,
    v: Vector,
    period: float,
    acceleration: Callable[[Vector, Vector], Vector],
    integrate: Callable[[Vector, Vector], Vector],
) -> tuple[Vector, Vector]:
    """Return positions and velocities after a step.

    Args:
        q: Positions.
        v: Velocities; a base's twist uses the axes in which its motions add up: the world's for
            its origin, its own for its rotation.
        period: Length of the step, in s.
        acceleration: Returns the time derivative of the velocities in a state.
        integrate: Returns the positions after a motion.
    """
    half = 0.5 * period
    a1 = acceleration(q, v)
    v2 = v + half * a1
    a2 = acceleration(integrate(q, half * v), v2)
    v3 = v + half * a2
    a3 = acceleration(integrate(q, half * v2), v3)
    v4 = v + period * a3
    a4 = acceleration(integrate(q, period * v3), v4)
    motion = period / 6 * (v + 2 * v2 + 2 * v3 + v4)
    return integrate(q, motion), v + period / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
