"""The section on how a training went."""

from __future__ import annotations

from collections.abc import Iterator

from physx_report import drawing, wording
from physx_report.blocks import Block, Table
from physx_report.run import Run
from physx_report.section import Section

_SHOWN = {"epoch": ("loss/training", "loss/validation"), "batch": ("loss/batch",)}


def _blocks(run: Run) -> Iterator[Block]:
    result = run.training
    if result is None:
        return
    losses = {
        timeline: {
            name.removeprefix("loss/"): steps
            for (of, name), steps in run.scalars.items()
            if of == timeline and name in shown
        }
        for timeline, shown in _SHOWN.items()
    }
    for timeline, series in losses.items():
        if any(len(steps) > 1 for steps in series.values()):
            caption = f"Loss by {timeline}, in normalized units where the training normalizes"
            with drawing.figure(caption) as (found, (axes,)):
                drawing.curves(axes, series, timeline)
                axes.set_ylabel("loss")
            yield from found
    numbers = [[name, wording.number(value)] for name, value in result.numbers.items()]
    yield Table(["", ""], [["duration / s", wording.number(result.seconds)], *numbers], "Numbers")


SECTION = Section("Training", _blocks, 30)
