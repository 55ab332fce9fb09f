"""Agreement: how far engines agree on a task; a plain value that is printed and stored."""

from __future__ import annotations

import dataclasses
import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from physx_agree import wording
from physx_agree.causes import Parting
from physx_agree.scores import Ranking, Score


@dataclass(frozen=True)
class Agreement:
    """How far engines agree on a task, and why they part.

    Attributes:
        task: The task.
        metric: What is compared: ``"return"``, ``"length"``, or a name of the information of steps.
        engines: The engines, the first of which the others are compared with.
        seeds: Seeds of the episodes.
        scores: The metric of each policy on each engine.
        rankings: For each pair of policies, whether its order survives.
        partings: For each other engine, where and why its steps part from those of the first.
    """

    task: str
    metric: str
    engines: Sequence[str]
    seeds: Sequence[int]
    scores: Sequence[Score]
    rankings: Sequence[Ranking]
    partings: Sequence[Parting]

    def to_plain(self) -> dict[str, Any]:
        """Return all of it as plain data."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self)))
        return plain

    def to_json(self) -> str:
        """Return all of it as JSON."""
        return json.dumps(self.to_plain(), indent=1)

    def __str__(self) -> str:
        head = f"{self.task}: {self.metric} of {len(self.seeds)} episodes"
        lines = [
            *textwrap.wrap(f"{head}, seeds {wording.span(self.seeds)}", wording.WIDTH),
            "",
            *wording.columns([wording.HEAD, *map(wording.row_of, self.scores)]),
        ]
        for ranking in self.rankings:
            text = wording.ranking_text(ranking)
            lines += ["", *textwrap.wrap(text, wording.WIDTH, subsequent_indent="  ")]
        for parting in self.partings:
            lines += ["", *wording.parting_lines(parting)]
        return "\n".join(lines)
