"""Scores of episodes: means, differences between engines on the same seeds, and rankings."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

Interval = tuple[float, float]
_LEVEL = 0.95


@dataclass(frozen=True)
class Score:
    """The metric of a policy on an engine.

    Attributes:
        policy: The policy.
        engine: The engine.
        values: The metric by seed.
        difference: Mean difference from the first engine on the same seeds; None for the first.
        interval: 95 % interval of that difference; None: fewer than three seeds.
    """

    policy: str
    engine: str
    values: Sequence[float]
    difference: float | None = None
    interval: Interval | None = None

    @property
    def mean(self) -> float:
        """The mean over seeds."""
        return math.fsum(self.values) / len(self.values)


@dataclass(frozen=True)
class Ranking:
    """Two policies on all engines.

    Attributes:
        policies: The better one on the first engine, and the other.
        margins: Mean difference of their metrics on the same seeds, by engine.
        intervals: 95 % intervals of these differences; None: fewer than three seeds.
        verdict: "survives", if all intervals are above 0; "reversed", if the first is above and
            another below; else "open".
    """

    policies: tuple[str, str]
    margins: Mapping[str, float]
    intervals: Mapping[str, Interval | None]
    verdict: str


def scores_by_engine(policy: str, values: Mapping[str, Sequence[float]]) -> list[Score]:
    """Return the scores of a policy on each engine, the first of which the others differ from."""
    first = next(iter(values))
    found = [Score(policy, first, tuple(values[first]))]
    for engine in list(values)[1:]:
        differences = np.subtract(values[engine], values[first])
        found.append(
            Score(
                policy, engine, tuple(values[engine]), float(differences.mean()),
                interval_of(differences.tolist()),
            )
        )  # fmt: skip
    return found


def rankings(scores: Sequence[Score]) -> list[Ranking]:
    """Return for each pair of policies whether their order is the same on all engines."""
    known = {(each.policy, each.engine): each for each in scores}
    policies = list(dict.fromkeys(each.policy for each in scores))
    engines = list(dict.fromkeys(each.engine for each in scores))
    found = []
    for pair in itertools.combinations(policies, 2):
        better, worse = sorted(pair, key=lambda name: -known[name, engines[0]].mean)
        margins = {
            engine: np.subtract(known[better, engine].values, known[worse, engine].values).tolist()
            for engine in engines
        }
        intervals = {engine: interval_of(values) for engine, values in margins.items()}
        means = {engine: math.fsum(values) / len(values) for engine, values in margins.items()}
        found.append(Ranking((better, worse), means, intervals, _verdict(list(intervals.values()))))
    return found


def _verdict(intervals: Sequence[Interval | None]) -> str:
    first, *others = intervals
    if first is None or not first[0] > 0:
        return "open"
    if any(each is not None and each[1] < 0 for each in others):
        return "reversed"
    return "survives" if all(each is not None and each[0] > 0 for each in others) else "open"


def interval_of(values: Sequence[float]) -> Interval | None:
    """Return Student's 95 % interval of a mean; None: fewer than three values."""
    count = len(values)
    if count < 3:
        return None
    mean = math.fsum(values) / count
    deviation = math.sqrt(math.fsum((value - mean) ** 2 for value in values) / (count - 1))
    width = student(0.5 + 0.5 * _LEVEL, count - 1) * deviation / math.sqrt(count)
    return mean - width, mean + width


def student(probability: float, freedom: int) -> float:
    """Return a quantile of Student's distribution, within 2 % from two degrees of freedom on.

    The expansion of M. Abramowitz and I. A. Stegun, "Handbook of mathematical functions", 26.7.5;
    for two degrees, the exact formula.
    """
    if freedom == 2:
        spread = 2.0 * probability - 1.0
        return spread * math.sqrt(2.0 / (1.0 - spread * spread))
    x = NormalDist().inv_cdf(probability)
    terms = (
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
        (79 * x**9 + 776 * x**7 + 1482 * x**5 - 1920 * x**3 - 945 * x) / 92160,
    )
    return x + math.fsum(term / float(freedom) ** power for power, term in enumerate(terms, 1))
