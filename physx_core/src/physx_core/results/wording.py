"""Wording: numbers, intervals and verdicts as results tell them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypeAlias

Verdict: TypeAlias = Literal["wins", "loses", "even", "unknown"]
Interval: TypeAlias = tuple[float, float]

WORDS = {"wins": "better", "loses": "WORSE", "even": "no clear difference"}


def number(value: float) -> str:
    """Return a number of three digits."""
    return f"{value:.3g}"


def percent(value: float) -> str:
    """Return a share in percent."""
    return f"{value * 100:.3g} %"


def between(interval: Interval | None) -> str:
    """Return the limits of an interval; empty without one."""
    return "" if interval is None else f"{number(interval[0])} to {number(interval[1])}"


def plain(value: Any) -> str:
    """Return a parameter's value."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(plain, value))}]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows of a table as lines, indented by two blanks; the first column to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(
            cell.ljust(size) if not place else cell.rjust(size)
            for place, (cell, size) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]  # fmt: skip
