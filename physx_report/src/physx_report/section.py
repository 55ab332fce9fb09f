"""Section: a part of a report; plugins add their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from physx_core import plugins
from physx_report.blocks import Block
from physx_report.run import Run

KIND = "report_section"
"""The kind of component."""


@dataclass(frozen=True)
class Section:
    """A part of a report; a plugin's component.

    Attributes:
        title: Its title.
        blocks: Returns what it consists of; nothing if it does not apply to a run.
        rank: Sections come in the order of this number: sweep 5, quality 10, policy 12,
            rollouts 15, film 18, episodes 20, training 30, samples 40, origin 90.
    """

    title: str
    blocks: Callable[[Run], Iterable[Block]]
    rank: int = 50


def all_sections() -> list[Section]:
    """Return the sections of all plugins, in their order; broken ones are left out."""
    return sorted(
        plugins.resolve_all(KIND).values(), key=lambda section: (section.rank, section.title)
    )
