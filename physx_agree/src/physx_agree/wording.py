"""Wording: scores, rankings and partings as text of 80 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence

from physx_agree.causes import Parting
from physx_agree.scores import Interval, Ranking, Score

WIDTH = 80
"""Longest line, in columns."""


def span(seeds: Sequence[int]) -> str:
    """Return the first and the last seed."""
    return str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"


HEAD = ("policy", "engine", "mean", "difference", "95 % interval")


def row_of(score: Score) -> tuple[str, ...]:
    """Return the cells of a score's row under `HEAD`."""
    difference = "" if score.difference is None else f"{score.difference:+.4g}"
    between = "" if score.difference is None else between_of(score.interval)
    return score.policy, score.engine, f"{score.mean:.4g}", difference, between


def between_of(interval: Interval | None) -> str:
    """Return an interval as text."""
    return "too few seeds" if interval is None else f"{interval[0]:+.3g} to {interval[1]:+.3g}"


def ranking_text(ranking: Ranking) -> str:
    """Return a ranking as a sentence."""
    better, worse = ranking.policies
    margins = ", ".join(
        f"{engine} {margin:+.4g} ({between_of(ranking.intervals[engine])})"
        for engine, margin in ranking.margins.items()
    )
    return f"{better} above {worse}: {ranking.verdict}; {margins}"


def parting_text(parting: Parting) -> list[str]:
    """Return where two engines part, as sentences."""
    first, second = parting.engines
    told = f"{first} and {second}: {parting.parted} of {parting.steps} physics steps part them"
    if parting.first is not None:
        at = f"{parting.first} ({parting.first * parting.period:.4g} s)"
        told += (
            f", the first is step {at}{', through ' if parting.through else ''}{parting.through}"
        )
    apart, floor = parting.apart, parting.floor
    found = [
        f"{told}.",
        f"After a step from equal states they are {apart[0]:.2g} sqrt(J) apart (median), at most "
        f"{apart[1]:.2g}; {first} is {floor[0]:.2g}, at most {floor[1]:.2g}, from itself.",
    ]
    if parting.away is not None:
        rate = "" if parting.growth is None else f", growing by {parting.growth:.2g} per s"
        found.append(
            f"Under the same actions they are 1e-6 apart after {parting.away:.4g} s{rate}."
        )
    return found


def unexplained_text(parting: Parting) -> str:
    """Return how much no cause explains."""
    return f"{100 * parting.unexplained:.1f} % unexplained"


def percent(share: float) -> str:
    """Return a share as text; what lies above the engine or only in probes has none."""
    return f"{100 * share:.0f} %" if share >= 0.005 else "-"


def parting_lines(parting: Parting) -> Iterator[str]:
    """Yield where and why two engines part, as lines."""
    for text in parting_text(parting):
        yield from textwrap.wrap(text, WIDTH)
    for cause in parting.causes:
        share = percent(cause.share)
        told = f"{cause.kind}: {cause.text} [{cause.confirmed}]"
        begin = f"  {share:>5}  "
        yield from textwrap.wrap(
            told, WIDTH, initial_indent=begin, subsequent_indent=" " * len(begin),
            break_on_hyphens=False,
        )  # fmt: skip
    if parting.parted:
        yield f"         {unexplained_text(parting)}"
    for text in parting.unconfirmed:
        told = f"differs without moving a step: {text}"
        yield from textwrap.wrap(told, WIDTH, initial_indent="  ", subsequent_indent="    ")


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines with aligned columns; the first cells are shortened to fit."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    first = max(8, widths[0] - max(0, sum(widths) + 2 * len(widths) - 2 - WIDTH))
    found = []
    for cell, *cells in rows:
        short = cell if len(cell) <= first else f"...{cell[3 - first :]}"
        rest = (f"{each:>{width}}" for each, width in zip(cells, widths[1:], strict=True))
        found.append("  ".join([f"{short:{first}}", *rest]).rstrip())
    return found
