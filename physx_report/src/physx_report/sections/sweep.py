"""The section on what the trials of a sweep have found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes

from physx_core.results import SettingResult, SweepResult
from physx_report import drawing, wording
from physx_report.blocks import Block, Table, Text
from physx_report.run import Run
from physx_report.section import Section

_MOST_ROWS = 200
_COLUMNS = 3


def _blocks(run: Run) -> Iterator[Block]:
    result = run.results.get("sweep")
    if result is None or result.sweep is None:
        return
    sweep, best = result.sweep, result.sweep.best
    yield Text(list(result.summary), "plain")
    if best is not None:
        spread = "" if best.spread is None else f", with a spread over seeds of {best.spread:.2g}"
        mean = f" (mean of {len(best.values)} seeds{spread})" if len(best.values) > 1 else ""
        yield Text([f"Best: {best.text}: {sweep.number} {best.value:.4g}{mean}."], "verdict")
        yield Text(
            ["The number that chose the best setting makes it look better than it is: with many "
             "settings, some are good by chance. Measure the chosen one on samples of a test."]
        )  # fmt: skip
    yield from _numbers(sweep)
    yield _table(sweep)


def _numbers(sweep: SweepResult) -> Iterator[Block]:
    """Draw the number against each parameter."""
    settings = [each for each in sweep.settings if each.values]
    names = [n for n in dict.fromkeys(n for each in settings for n in each.parameters)
             if len({str(each.parameters.get(n)) for each in settings}) > 1]  # fmt: skip
    pipelines = list(dict.fromkeys(each.pipeline for each in settings))
    if len(pipelines) > 1:
        names = ["", *names]
    if not names:
        return
    rows, columns = -(-len(names) // _COLUMNS), min(len(names), _COLUMNS)
    caption = f"{sweep.number} of each trial by parameter; line: mean of all with the same value"
    with drawing.figure(caption, rows, columns, height=2.6) as (found, axes):
        for place, name in zip(axes, names, strict=False):
            points = [
                (each.pipeline if not name else each.parameters[name], value)
                for each in settings
                if not name or name in each.parameters
                for value in each.values.values()
            ]
            _draw(place, [x for x, _ in points], [y for _, y in points])
            place.set_xlabel(name.rpartition(".")[2] or "pipeline")
        for place in axes[len(names) :]:
            place.set_axis_off()
        for place in axes[::columns]:
            place.set_ylabel(sweep.number)
    yield from found


def _draw(axes: Axes, given: Sequence[object], values: Sequence[float]) -> None:
    numbers = [x for x in given if isinstance(x, (int, float)) and not isinstance(x, bool)]
    if len(numbers) == len(given):
        x = np.array(numbers, float)
        if x.min() > 0 and x.max() > 20 * x.min():
            axes.set_xscale("log")
    else:
        labels = list(dict.fromkeys(map(str, given)))
        x = np.array([labels.index(str(each)) for each in given], float)
        axes.set_xticks(range(len(labels)), labels, rotation=20)
    y = np.array(values)
    axes.plot(x, y, ".", color=drawing.MUTED, ms=5)
    known, place = np.unique(x, return_inverse=True)
    if len(known) < len(x):
        means = np.bincount(place, y) / np.bincount(place)
        axes.plot(known, means, color=drawing.PREDICTION, lw=1.2)
    if (y > 0).all() and y.max() > 20 * y.min():
        axes.set_yscale("log")


def _table(sweep: SweepResult) -> Table:
    ranked = sweep.ranked
    rest = [each for each in sweep.settings if not each.is_complete]
    shown = [*ranked, *rest][:_MOST_ROWS]
    names = list(dict.fromkeys(name for each in shown for name in each.parameters))
    short = [name.rpartition(".")[2] for name in names]
    labels = [s if short.count(s) == 1 else n for s, n in zip(short, names, strict=True)]
    rows = [
        [
            each.pipeline,
            *(wording.value(each.parameters.get(name, "")) for name in names),
            f"{each.value:.4g}" if each.values else "",
            *_spread(each),
            ", ".join(each.folders),
        ]
        for each in shown
    ]
    left = len(sweep.settings) - len(shown)
    more = f"; {left} more are left out" if left else ""
    caption = f"Settings, the best first{more}"
    own = [sweep.number, "spread over seeds", "trials without a number", "sessions"]
    return Table(["pipeline", *labels, *own], rows, caption, [0] if ranked else [])


def _spread(of: SettingResult) -> tuple[str, str]:
    others = ", ".join(f"{why} (seed {seed})" for seed, why in of.others.items())
    return "" if of.spread is None else f"{of.spread:.2g}", others


SECTION = Section("What the trials have found", _blocks, 5)
