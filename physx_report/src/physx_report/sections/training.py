"""The section on how a training went."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from physx_core import Result
from physx_core.errors import SessionError
from physx_core.results import read_results
from physx_report import drawing, wording
from physx_report.blocks import Block, Table, Text
from physx_report.run import Run
from physx_report.section import Section

_PREDICTED, _GENERATED = "predicted samples per s", "generated samples per s"
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
    yield from _speed(result)
    numbers = [[name, wording.number(value)] for name, value in result.numbers.items()]
    yield Table(["", ""], [["duration / s", wording.number(result.seconds)], *numbers], "Numbers")


def _speed(result: Result) -> Iterator[Text]:
    """Say how fast the network is, and how fast the samples were simulated that it learned from."""
    rates = [(_PREDICTED, "The network predicted", result.numbers)]
    place = result.places.get("dataset")
    if place is not None:
        with contextlib.suppress(SessionError):
            made = read_results(Path(place).parent).get("data_generation")
            rates += [(_GENERATED, "their simulation generated", made.numbers)] if made else []
    told = [f"{text} {known[name]:,.0f} samples per s" for name, text, known in rates
            if name in known]  # fmt: skip
    if len(told) > 1:
        yield Text([f"{', '.join(told)}, each on the machine and in the processes of its run."])


SECTION = Section("Training", _blocks, 30)
