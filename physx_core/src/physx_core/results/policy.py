"""PolicyResult: how good a network is that acts in an environment, in episodes by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

from physx_core.results.wording import WORDS, Interval, Verdict, between, number


@dataclass(frozen=True)
class ActionsResult:
    """What actions that need no policy achieve, in episodes with the same seeds.

    Attributes:
        rewards: The sum of rewards of each episode, in the order of `PolicyResult.seeds`.
        verdict: "wins" or "loses", of the policy, if neither episodes drawn at random (a paired
            bootstrap) nor random signs of their differences leave more than 1 % to chance; else
            "even"; "unknown" if there are too few episodes.
        difference: Mean reward of the policy minus that of these actions.
        interval: 99 % interval of that difference over episodes; None if there are too few.
        why: Why nothing can be said; else empty.
    """

    rewards: Sequence[float]
    verdict: Verdict = "unknown"
    difference: float = 0.0
    interval: Interval | None = None
    why: str = ""

    @property
    def mean(self) -> float:
        """The mean reward of an episode."""
        return sum(self.rewards) / len(self.rewards)

    @property
    def text(self) -> str:
        """The verdict in words."""
        if self.verdict == "unknown":
            return self.why
        gained = f"{number(self.difference)} in an episode ({between(self.interval)})"
        return f"the policy: {WORDS[self.verdict]}, by {gained}"


@dataclass(frozen=True)
class PolicyResult:
    """How good a network is that acts in an environment.

    Attributes:
        environment: Id of the environment.
        backend: The engine; empty: the environment's own.
        network: Name of the checkpoint.
        seeds: Seeds of the episodes.
        rewards: The sum of rewards of each episode.
        interval: 95 % interval of the mean reward over episodes; None if there are too few.
        figures: What else is known of each episode, by name: ``length`` in steps, and as far as
            the environment tells, ``speed`` in m/s and ``success``, 0 or 1.
        rivals: Actions that need no policy, by name.
        film: File of the film of the first episode; empty: there is none.
    """

    environment: str
    backend: str
    network: str
    seeds: Sequence[int]
    rewards: Sequence[float]
    interval: Interval | None = None
    figures: Mapping[str, Sequence[float]] = field(default_factory=dict)
    rivals: Mapping[str, ActionsResult] = field(default_factory=dict)
    film: str = ""

    @classmethod
    def of(
        cls,
        environment: str,
        backend: str,
        network: str,
        figures: Mapping[str, Sequence[float]],
        rivals: Mapping[str, Sequence[float]],
        *,
        film: str = "",
    ) -> Self:
        """Compare a policy with actions that need none.

        Args:
            environment: Id of the environment.
            backend: The engine; empty: the environment's own.
            network: Name of the checkpoint.
            figures: Numbers of each episode by name, with ``seed`` and ``reward``.
            rivals: Rewards of the episodes by name of the actions, with the same seeds.
            film: File of the film of the first episode.
        """
        from physx_core.results.errors import compare_rewards, mean_interval  # NumPy only here

        others = {n: list(v) for n, v in figures.items() if n not in ("seed", "reward")}
        seeds, rewards = [int(seed) for seed in figures["seed"]], list(figures["reward"])
        known = {
            name: ActionsResult(list(other), **compare_rewards(rewards, other))
            for name, other in rivals.items()
        }
        interval = mean_interval(rewards)
        return cls(environment, backend, network, seeds, rewards, interval, others, known, film)

    @property
    def values(self) -> dict[str, float]:
        """The means over episodes: ``reward``, `figures`, and ``reward/RIVAL``."""
        found = {"reward": sum(self.rewards) / len(self.rewards)}
        found |= {name: sum(each) / len(each) for name, each in self.figures.items()}
        return found | {f"reward/{name}": rival.mean for name, rival in self.rivals.items()}

    def lines(self, name: str) -> list[str]:
        """Return the text, line by line.

        Args:
            name: The environment, with its engine.
        """
        limits = f", 95 % interval {between(self.interval)}" if self.interval else ""
        seeds = f"{len(self.seeds)} episodes, seeds {min(self.seeds)} to {max(self.seeds)}"
        reward = number(self.values["reward"])
        found = [f"{name}: mean reward {reward}{limits} ({seeds})"]
        for rival, of in self.rivals.items():
            found.append(f"  {rival}: {number(of.mean)}; {of.text}")
        return found
