"""The section of a report on how far engines agree."""

from __future__ import annotations

from collections.abc import Iterator

from physx_agree import stored, wording
from physx_agree.causes import Parting
from physx_report import Run, Section, Table, Text


def _blocks(run: Run) -> Iterator[Text | Table]:
    found = stored.read_agreement(run.path)
    if found is None:
        return
    yield Text([
        f"{found.task}: {found.metric} of {len(found.seeds)} episodes, "
        f"seeds {wording.span(found.seeds)}"
    ])  # fmt: skip
    rows = [wording.row_of(score) for score in found.scores]
    yield Table(wording.HEAD, rows, "The same seeds and policies on each engine")
    if found.rankings:
        yield Text([wording.ranking_text(each) for each in found.rankings], "verdict")
    for parting in found.partings:
        yield from _parting(parting)


def _parting(parting: Parting) -> Iterator[Text | Table]:
    yield Text(wording.parting_text(parting))
    rows = [
        [cause.kind, cause.text, wording.percent(cause.share), cause.confirmed]
        for cause in parting.causes
    ]
    if rows:
        yield Table(
            ["cause", "what differs", "share", "confirmed by"],
            rows,
            f"Why {' and '.join(parting.engines)} part, {wording.unexplained_text(parting)}",
        )
    if parting.unconfirmed:
        yield Text([f"Differs without moving a step: {each}" for each in parting.unconfirmed])


SECTION = Section("How far engines agree", _blocks, 25)
