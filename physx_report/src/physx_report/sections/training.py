"""How a training went."""

from __future__ import annotations

from collections.abc import Iterator

from physx_report import drawing, wording
from physx_report.blocks import Block, Table
from physx_report.run import Run
from physx_report.section import Section


def _blocks(run: Run) -> Iterator[Block]:
    result = run.training
    if result is None:
        return
    losses = {
        "epoch": {n: s for (of, n), s in run.scalars.items() if of == "epoch" and "loss" in n},
        "batch": {n: s for (of, n), s in run.scalars.items() if n == "loss/batch"},
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
