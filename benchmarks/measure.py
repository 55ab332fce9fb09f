"""Interleaved timing: candidates run alternately, so a drifting machine affects all equally."""

from __future__ import annotations

import argparse
import heapq
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping


def list_schedule(durations: Iterable[float], workers: int) -> float:
    """Return when the last simulation ends if each worker takes the next one at once."""
    free = [0.0] * workers
    for duration in durations:
        heapq.heappush(free, heapq.heappop(free) + float(duration))
    return max(free)


def rates(
    candidates: Mapping[str, Callable[[], int | Iterator[int]]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Return units per second of each candidate in each round.

    Args:
        candidates: Name to a function that does some units of work and returns how many. A
            generator function prepares the work until its first ``yield``, does it until the
            second one, which yields the units, and cleans up afterwards.
        rounds: Number of rounds; one more round before them is not counted.
        clock: Tells the time; `time.process_time` if all work is done by this process.
    """
    measured: dict[str, list[float]] = {name: [] for name in candidates}
    for count in range(rounds + 1):
        for name, work in candidates.items():
            units, seconds = _timed(work, clock)
            if count:
                measured[name].append(units / seconds)
    return measured


def _timed(
    work: Callable[[], int | Iterator[int]], clock: Callable[[], float]
) -> tuple[int, float]:
    begin = clock()
    units = work()
    if isinstance(units, int):
        return units, clock() - begin
    steps = units
    next(steps)
    begin = clock()
    done = next(steps)
    seconds = clock() - begin
    next(steps, None)
    return done, seconds


def report(
    title: str,
    unit: str,
    measured: Mapping[str, list[float]],
    baseline: str,
    target: float,
    *of: str,
) -> bool:
    """Print the medians and their ratios to the baseline; return whether the target is met.

    Args:
        title: What was measured.
        unit: What was counted.
        measured: What `rates` returned.
        baseline: Name of the candidate that the others are compared with.
        target: Minimum ratio of the candidates `of`.
        of: Names of the candidates that the claim is about.
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
    met = [claim(name, ratios[name], at_least=target) for name in of]
    return all(met)


def claim(
    what: str, value: float, *, at_least: float | None = None, at_most: float | None = None
) -> bool:
    """Print and return whether a value meets its target."""
    if at_least is not None:
        met, target = value >= at_least, f"at least {at_least:g}"
    else:
        met, target = at_most is not None and value <= at_most, f"at most {at_most:g}"
    print(f"  {what}: {value:.4g}, target {target}: {'met' if met else 'MISSED'}\n")
    return met


def device() -> str:
    """Return the device that ``--device`` names; else the processor."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--device", default="cpu")
    return str(parser.parse_known_args()[0].device)


def finish(met: list[bool]) -> None:
    """End with status 1 if ``--check`` was given and a target was missed."""
    sys.exit(1 if "--check" in sys.argv and not all(met) else 0)
