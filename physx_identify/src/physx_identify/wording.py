"""Wording: identifications as text of 80 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from physx_identify.identification import Combination, Estimate, Identification

WIDTH = 80
HEAD = ("parameter", "unit", "nominal", "value", "interval", "")


def number(value: float) -> str:
    """Return a number with four digits."""
    return f"{value:.4g}"


def between(low: float | None, high: float | None) -> str:
    """Return an interval as text."""
    return "none" if low is None or high is None else f"{low:.4g} to {high:.4g}"


def row_of(each: Estimate) -> tuple[str, ...]:
    """Return the cells of an estimate's row under `HEAD`."""
    told = "" if each.verdict == "told" else each.verdict
    values = number(each.nominal), number(each.value), between(each.low, each.high)
    return each.name, each.unit, *values, told


def combination_text(each: Combination) -> str:
    """Return what is told of parameters together."""
    if len(each.factors) == 1:
        return f"{each}: no motion in this log tells anything of it"
    return f"{each}: {number(each.value)}, {between(each.low, each.high)}"


def verdict_lines(found: Identification) -> list[str]:
    """Return whether the intervals may be called by their level, and why not."""
    level = f"{100 * found.level:g} %"
    if not found.converged:
        return ["No intervals: two starts did not converge to the same values. Give priors, "
                "leave something known, or move more."]  # fmt: skip
    if found.lacks:
        return [
            f"These are not {level} intervals: what is left of the torques keeps a structure.",
            *(f"The model lacks {each}." for each in found.lacks),
        ]
    return [f"{level} intervals: no test of what is left of the torques found anything."]


def noise_text(found: Identification) -> str:
    """Return the log's noise as a sentence."""
    noise = found.noise
    torques = ", ".join(
        f"{number(deviation)} ({correlation:.2f})"
        for deviation, correlation in zip(noise.torque, noise.correlation, strict=True)
    )
    return (
        f"Noise: encoders {number(noise.encoder)}; torques, with their correlation from sample to "
        f"sample, {torques}."
    )


def lines_of(found: Identification) -> Iterator[str]:
    """Yield an identification as lines."""
    yield from textwrap.wrap(
        f"{found.robot} from {found.source}: {found.samples} samples, every {found.period:.4g} s",
        WIDTH,
    )
    yield ""
    yield from columns([HEAD, *map(row_of, found.estimates)])
    if found.combinations:
        yield ""
        yield "Inseparable in this log; told of them together:"
        for each in found.combinations:
            text = combination_text(each)
            yield from textwrap.wrap(
                text, WIDTH, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False
            )
    yield ""
    yield from textwrap.wrap(noise_text(found), WIDTH)
    for text in verdict_lines(found):
        yield from textwrap.wrap(text, WIDTH)


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            f"{cell:{width}}" if place < 2 or place == len(row) - 1 else f"{cell:>{width}}"
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
