"""SweepResult: what the trials of a sweep have found, by the parameters that they tried."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from physx_core.results.wording import aligned, number, plain

_SHOWN = 10


@dataclass(frozen=True)
class SettingResult:
    """What the trials with the same parameters have found.

    Attributes:
        pipeline: Name of the pipeline.
        parameters: Values of the parameters by name.
        values: The compared number of each complete trial, by its seed.
        others: Why other trials have none, by seed: "pruned", or the name of an error.
        folders: Folders of the trials' sessions, in the study's.
    """

    pipeline: str
    parameters: Mapping[str, Any]
    values: Mapping[str, float] = field(default_factory=dict)
    others: Mapping[str, str] = field(default_factory=dict)
    folders: Sequence[str] = ()

    @property
    def value(self) -> float:
        """The mean over the seeds."""
        return statistics.fmean(self.values.values())

    @property
    def spread(self) -> float | None:
        """The standard deviation over the seeds; None of fewer than two."""
        return statistics.stdev(self.values.values()) if len(self.values) > 1 else None

    @property
    def is_complete(self) -> bool:
        """Whether all of its trials have a number."""
        return bool(self.values) and not self.others

    @property
    def text(self) -> str:
        """The pipeline and the parameters in words."""
        given = [f"{n.rpartition('.')[2]} {plain(v)}" for n, v in self.parameters.items()]
        return ", ".join([self.pipeline, *given])


@dataclass(frozen=True)
class SweepResult:
    """What the trials of a sweep have found.

    Attributes:
        number: Name of the number that is compared.
        goal: Whether the smallest or the largest is the best.
        settings: What was tried.
    """

    number: str
    goal: Literal["minimize", "maximize"]
    settings: Sequence[SettingResult]

    @property
    def ranked(self) -> list[SettingResult]:
        """The settings of which all trials have a number, the best one first."""
        sign = 1 if self.goal == "minimize" else -1
        whole = [each for each in self.settings if each.is_complete]
        return sorted(whole, key=lambda each: sign * each.value)

    @property
    def best(self) -> SettingResult | None:
        """The best setting; None if of none all trials have a number."""
        return next(iter(self.ranked), None)

    @property
    def lines(self) -> list[str]:
        """The text, line by line."""
        ranked = self.ranked
        rows = [["setting", self.number, "spread over seeds"]]
        for each in ranked[:_SHOWN]:
            spread = "" if each.spread is None else number(each.spread)
            rows.append([each.text, f"{each.value:.6g}", spread])
        found = aligned(rows) if ranked else []
        if left := len(self.settings) - len(ranked[:_SHOWN]):
            found.append(f"  {left} other settings")
        return found
