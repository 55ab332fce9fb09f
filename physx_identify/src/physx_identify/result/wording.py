"""Wording: identifications as text of 80 columns."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from physx_identify.result.estimates import (
    DEPENDENT,
    Combination,
    EngineFit,
    Estimate,
    LogNoise,
)

WIDTH = 80
TOGETHER = "Inseparable in this log; told of them together"
ELSEWHERE = "Fitted with the steps of engines: differences in standard errors"
HEAD = ("parameter", "unit", "nominal", "value", "interval", "")
WORDS = (0, 1, 5)
"""Which of these columns are words."""


def number(value: float) -> str:
    """Return a number with four digits."""
    return f"{value:.4g}"


def between(low: float | None, high: float | None) -> str:
    """Return an interval as text."""
    return "none" if low is None or high is None else f"{low:.4g} to {high:.4g}"


def row_of(each: Estimate) -> tuple[str, ...]:
    """Return the cells of an estimate's row under `HEAD`."""
    words = ["by profile"] if each.method == "profile" else []
    told = ", ".join(words if each.verdict == "told" else [each.verdict, *words])
    values = number(each.nominal), number(each.value), between(each.low, each.high)
    return each.name, each.unit, *values, told


def combination_text(each: Combination) -> str:
    """Return what is told of parameters together."""
    if len(each.factors) == 1:
        return f"{each}: no motion in this log tells anything of it"
    return f"{each}: {number(each.value)}, {between(each.low, each.high)}"


def verdict_lines(level: float, converged: bool, lacks: Sequence[str]) -> list[str]:
    """Return whether the intervals may be called by their level, and why not."""
    if not converged:
        return [
            "No intervals: two starts did not converge to the same values. Give priors, leave "
            "something known, or move more."
        ]
    if lacks:
        return [
            f"These are not {100 * level:g} % intervals: what is left of the torques keeps a "
            "structure.",
            *(f"The model lacks {each}." for each in lacks),
        ]
    return [f"{100 * level:g} % intervals: no test of what is left of the torques found anything."]


def origin_text(robot: str, source: str, samples: int, period: float) -> str:
    """Return what was identified from what."""
    return f"{robot} from {source}: {samples} samples, every {period:.4g} s"


def noise_text(noise: LogNoise) -> str:
    """Return the log's noise as a sentence."""
    torques = ", ".join(
        f"{number(deviation)} ({correlation:.2f})"
        for deviation, correlation in zip(noise.torque, noise.correlation, strict=True)
    )
    return (
        f"Noise: encoders {number(noise.encoder)}; torques, with their correlation from sample to "
        f"sample, {torques}."
    )


def engine_rows(engines: Sequence[EngineFit]) -> list[tuple[str, ...]]:
    """Return a head, and for each parameter its differences on engines."""
    names = list(engines[0].differences) if engines else []
    return [
        ("parameter", *(each.engine for each in engines)),
        *((name, *(f"{each.differences[name]:+.2f}" for each in engines)) for name in names),
    ]


def engine_lines(engines: Sequence[EngineFit]) -> list[str]:
    """Return which values depend on the engine, and what was left out."""
    lines = [
        f"Depends on the engine: {name}, {each.values[name]:.4g} on {each.engine}."
        for each in engines
        for name in each.dependent
    ]
    lines = lines or [f"None is {DEPENDENT:g} standard errors off: no value depends on the engine."]
    return lines + [
        f"On {each.engine}, no torque leads to the next sample from {each.stopped} (limits of "
        "joints, or dry friction): left out."
        for each in engines
        if each.stopped
    ]


def columns(rows: Sequence[Sequence[str]], words: Collection[int] = (0,)) -> list[str]:
    """Return rows as lines with aligned columns, those of words to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            f"{cell:{width}}" if place in words else f"{cell:>{width}}"
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
