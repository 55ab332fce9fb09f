"""Causes and partings: differences between two engines, as plain values that are stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """Why two engines part, confirmed by an experiment.

    Attributes:
        kind: ``"description"``, ``"above the engine"``; what engines hold: ``"mass"``,
            ``"armature"``, ``"gravity"``, ``"stiffness"``, ``"damping"``, ``"friction"`` of joints,
            ``"torque limit"``, ``"friction of contacts"``, ``"restitution"``; how they act:
            ``"limit"``, ``"contact gap"``, ``"recovery of penetration"``, ``"friction law"``,
            ``"contact set"``, ``"contact solver"``, ``"integrator"``; or ``"sensitivity"``.
        text: What differs, with values of both engines.
        share: Which part of all differences after single steps it makes, from 0 to 1.
        confirmed: What moved when it was taken away.
    """

    kind: str
    text: str
    share: float
    confirmed: str


@dataclass(frozen=True)
class Parting:
    """Where and why the steps of two engines part.

    Differences of velocities after one step from equal states are in sqrt(J): their norm is that of
    the mass matrix, whose square is twice a kinetic energy.

    Attributes:
        engines: The engine whose episode is repeated, and the other.
        seed: Of the episode.
        steps: Number of physics steps that were compared.
        period: Duration of a physics step, in s.
        parted: Number of steps whose difference is larger than ten times the floor.
        first: The first of them, from 0; None: none.
        through: Kind of the cause that makes most of the difference of that step.
        apart: Median and largest difference.
        floor: Median and largest difference of the first engine from itself.
        causes: Why, the largest share first; only what was confirmed.
        unconfirmed: What differs too, but moved no step.
        unexplained: Share of all differences that no cause explains; 0 if no step parts.
        away: When the episodes, under the same actions, are 1e-6 rad or m apart, in s; None: never.
        growth: Rate at which they move apart, in 1/s; None: too few steps to say, or they do not.
    """

    engines: tuple[str, str]
    seed: int
    steps: int
    period: float
    parted: int
    first: int | None
    through: str
    apart: tuple[float, float]
    floor: tuple[float, float]
    causes: Sequence[Cause]
    unconfirmed: Sequence[str]
    unexplained: float
    away: float | None
    growth: float | None
