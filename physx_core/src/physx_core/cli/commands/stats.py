"""``physx stats``: show a training's statistics as a table or in TensorBoard."""

from __future__ import annotations

import importlib.util
import itertools
import math
import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physx_core.cli.options import options_from
from physx_core.cli.output import show, show_table, width
from physx_core.dataset import Dataset
from physx_core.errors import DatasetError, MissingLibraryError, SessionError
from physx_core.observers import FIELDS, read_scalars
from physx_core.processes import ChildProcess

BARS = "▁▂▃▄▅▆▇█"
_FEWEST_BARS = 12
_ROWS = f"{FIELDS}/"


@dataclass
class Stats:
    """Show the statistics recorded in a session."""

    session: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SESSION")]
    """The session's folder."""
    width: int | None = None
    """Width of the spark lines in characters; by default the rest of the terminal's width."""
    tensorboard: bool = False
    """Start TensorBoard and print its address; Ctrl-C stops it."""
    port: int = 6006
    """Port of TensorBoard, which is reachable only from this machine."""


def run(words: Sequence[str]) -> None:
    """Print a line for each statistic, or start TensorBoard."""
    options = options_from(Stats, words, "stats")
    if options.tensorboard:
        _start_tensorboard(Path(options.session), options.port)
        return
    series = read_scalars(Path(options.session))
    if not series:
        raise SessionError(f"{options.session} has no statistics: only training runs record them.")
    of_rows = {name: steps for (_, name), steps in series.items() if name.startswith(_ROWS)}
    series = {key: steps for key, steps in series.items() if key[1] not in of_rows}
    numbers = ("number", "last", "min", "max", "mean")
    lines = [_line(*key, list(steps.values())) for key, steps in series.items()]
    head = ("name", "per", *numbers)
    used = sum(2 + max(map(len, column)) for column in zip(head, *lines, strict=True))
    bars = max(_FEWEST_BARS, width() - used) if options.width is None else options.width
    curves = [spark_line(list(steps.values()), bars) for steps in series.values()]
    rows = [(*line, curve) for line, curve in zip(lines, curves, strict=True)]
    show_table((*head, ""), rows, numbers=numbers, curve="")
    if of_rows:
        show()
        _show_rows(of_rows, _units(Path(options.session)))


def _units(session: Path) -> dict[str, str]:
    """Return the units of the fields in the session's dataset; empty if it cannot be read."""
    try:
        with Dataset.open(session) as dataset:
            fields = [of for mode in dataset.modes for of in dataset.fields(mode).values()]
    except DatasetError:
        return {}
    return {of.name: of.unit for of in fields}


def _show_rows(numbers: Mapping[str, Mapping[int, float]], units: Mapping[str, str]) -> None:
    """Print the last statistics of the rows that environments generated, by field."""
    table: dict[str, dict[str, str]] = {}
    for name, steps in numbers.items():
        of, _, figure = name.removeprefix(_ROWS).rpartition("/")
        table.setdefault(of, {})[figure] = f"{list(steps.values())[-1]:.4g}"
    figures = list(dict.fromkeys(figure for values in table.values() for figure in values))
    rows = [
        (of, *(values.get(name, "") for name in figures), units.get(of.partition("/")[0], ""))
        for of, values in table.items()
    ]
    show_table(("field", *figures, "unit"), rows, numbers=figures)


def _line(timeline: str, name: str, values: list[float]) -> tuple[str, ...]:
    finite = [value for value in values if math.isfinite(value)] or [math.nan]
    figures = (values[-1], min(finite), max(finite), statistics.fmean(finite))
    return name, timeline, str(len(values)), *(f"{value:.4g}" for value in figures)


def spark_line(values: Sequence[float], width: int) -> str:
    """Return a curve of at most `width` bars, scaled from the smallest to the largest value.

    Each bar is the mean of consecutive values. If all are positive and span more than a factor of
    100, the bars show their logarithms. NaN and infinity appear as "x".
    """
    size = min(width, len(values))
    edges = [len(values) * number // max(1, size) for number in range(size + 1)]
    means = [statistics.fmean(values[a:b]) for a, b in itertools.pairwise(edges)]
    finite = [mean for mean in means if math.isfinite(mean)]
    if finite and min(finite) > 0 and max(finite) > 100 * min(finite):
        means = [math.log(mean) if math.isfinite(mean) else mean for mean in means]
    return "".join(_bars(means))


def _bars(values: Sequence[float]) -> Iterable[str]:
    finite = [value for value in values if math.isfinite(value)]
    low = min(finite, default=0.0)
    span = max(finite, default=0.0) - low
    for value in values:
        if not math.isfinite(value):
            yield "x"
        else:
            yield BARS[int((value - low) / span * (len(BARS) - 1) + 0.5)] if span else BARS[0]


def _start_tensorboard(session: Path, port: int) -> None:
    folder = session / "stats" / "tensorboard"
    if not folder.is_dir():
        raise SessionError(
            f'There is no {folder}: train with statistics=["torch/tensorboard"], or '
            "--statistics torch/tensorboard. Without --tensorboard, a table is printed."
        )
    if importlib.util.find_spec("tensorboard") is None:
        raise MissingLibraryError(
            "physx stats --tensorboard", "tensorboard", "tensorboard", "physx-torch"
        )
    place = ("--logdir", str(folder), "--host", "127.0.0.1", "--port", str(port))
    with ChildProcess([sys.executable, "-m", "tensorboard.main", *place]) as process:
        sys.exit(process.wait())
