"""Estimates: what a log says about parameters and its own noise, one by one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """What the log says about one parameter.

    Attributes:
        name: Such as ``"friction elbow"``.
        kind: As in `Unknown`.
        of: Name of the link or joint.
        part: Which number of an inertia.
        unit: Its unit.
        nominal: In the robot's file and settings.
        value: The most likely value that is physical.
        verdict: ``"told"``; ``"hardly told"``: the interval is wider than the value; or
            ``"inseparable"``.
        error: Standard error; None: the parameter cannot be told from others.
        low: Lower end of the interval; None likewise, or if the fit did not converge.
        high: Upper end.
        method: How the interval was found: ``"quadratic"``, from the standard error; or
            ``"profile"``, from the likelihood, where it is not quadratic.
        blocks: Standard error from the spread between blocks of the log, relative to `error`: a
            check, about 1.
    """

    name: str
    kind: str
    of: str
    part: str
    unit: str
    nominal: float
    value: float
    verdict: str
    error: float | None = None
    low: float | None = None
    high: float | None = None
    blocks: float | None = None
    method: str = "quadratic"


@dataclass(frozen=True)
class Combination:
    """A sum of parameters that the log tells, although it cannot tell them apart.

    Attributes:
        factors: Factor of each parameter, by name.
        value: Of the sum.
        low: Lower end of its interval.
        high: Upper end.
    """

    factors: Mapping[str, float]
    value: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        return " + ".join(
            name if factor == 1 else f"{factor:.4g} x {name}"
            for name, factor in self.factors.items()
        ).replace("+ -", "- ")


@dataclass(frozen=True)
class LogNoise:
    """Noise of a log.

    Attributes:
        encoder: Standard deviation of the positions, in rad or m.
        torque: Standard deviation of each torque, in N m or N.
        correlation: Of each torque, from sample to sample.
        order: Order of the autoregression.
        innovations: Deviation of the autoregression's innovations, of each torque.
        regression: Its coefficients, of each torque.
    """

    encoder: float
    torque: Sequence[float]
    correlation: Sequence[float]
    order: int
    innovations: Sequence[float]
    regression: Sequence[Sequence[float]]


DEPENDENT = 3.0
"""Difference between engines, in standard errors, above which a value depends on the engine."""


@dataclass(frozen=True)
class EngineFit:
    """What the log says with the steps of an engine in place of the fit's own.

    Attributes:
        engine: Name of the engine.
        values: Of each parameter that the log tells, by name.
        differences: Of these values from the fit's, in standard errors.
        torques: Root mean square of what the torques of its steps differ by, of each joint, in N m
            or N, at the fit's values if these do not depend on the engine.
        stopped: Number of samples that are left out, as no torque leads to the next one on the
            engine: at limits of joints, or where they stick.
    """

    engine: str
    values: Mapping[str, float]
    differences: Mapping[str, float]
    torques: Sequence[float]
    stopped: int = 0

    @property
    def dependent(self) -> list[str]:
        """Names of the parameters whose values depend on the engine."""
        return [name for name, each in self.differences.items() if abs(each) > DEPENDENT]
