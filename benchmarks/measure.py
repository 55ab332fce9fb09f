"""Interleaved timing: the candidates run in turn, so that a drifting machine treats all alike."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Mapping


def rates(candidates: Mapping[str, Callable[[], int]], rounds: int) -> dict[str, list[float]]:
    """Return units per second of each candidate in each round.

    Args:
        candidates: Name to a function that does some units of work and returns how many.
        rounds: How many times each runs; one more round before is not counted.
    """
    measured: dict[str, list[float]] = {name: [] for name in candidates}
    for count in range(rounds + 1):
        for name, work in candidates.items():
            begin = time.perf_counter()
            units = work()
            rate = units / (time.perf_counter() - begin)
            if count:
                measured[name].append(rate)
    return measured


def report(
    title: str,
    unit: str,
    measured: Mapping[str, list[float]],
    baseline: str,
    target: float,
    of: str,
) -> bool:
    """Print the medians and their ratios to the baseline; return whether the target is met.

    Args:
        title: What was measured.
        unit: What was counted.
        measured: What `rates` returned.
        baseline: Name of the candidate that the others are compared with.
        target: Least ratio of the candidate `of`.
        of: Name of the candidate that the claim is about.
    """
    print(title)
    ratios = {
        name: statistics.median(
            mine / base for mine, base in zip(values, measured[baseline], strict=True)
        )
        for name, values in measured.items()
    }
    for name, values in measured.items():
        low, middle, high = min(values), statistics.median(values), max(values)
        print(
            f"  {name:28} {middle:12,.0f} {unit}/s  [{low:,.0f} .. {high:,.0f}]"
            f"  ratio {ratios[name]:.2f}"
        )
    met = ratios[of] >= target
    print(f"  {of}: {ratios[of]:.2f}, target {target}: {'met' if met else 'MISSED'}\n")
    return met


def finish(met: list[bool]) -> None:
    """End with status 1 if ``--check`` was given and a target was missed."""
    sys.exit(1 if "--check" in sys.argv and not all(met) else 0)
