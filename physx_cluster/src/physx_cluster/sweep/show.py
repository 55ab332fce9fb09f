"""Shows a study as a table, as curves in a viewer, or as a figure."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from physx_cluster.errors import StudyError
from physx_cluster.sweep.parameters import Range
from physx_cluster.sweep.results import COMPLETE, PRUNED, Trial
from physx_cluster.sweep.runner import describe_trial
from physx_cluster.sweep.study import Best, Study
from physx_core import plugins, read_scalars
from physx_core.cli import show, show_table, spark_line, width
from physx_core.errors import MissingLibraryError, SessionError, UsageError

_BARS = 16
_GAP = 2  # characters between the columns of a table
_MARK = "*"


def show_status(study: Study) -> None:
    """Print a line for each trial, then the best setting."""
    names = study.definition.columns
    best = study.best()
    marked = {trial.number for trial in best.trials} if best is not None else set()
    trials, rows = [trial for _, trial in sorted(study.trials.items())], []
    for trial in trials:
        values = [_text(trial.values.get(name)) for name in names]
        mark = _MARK if trial.number in marked else ""
        place = (f"{mark}{trial.number}", trial.pipeline, *values, str(trial.seed))
        rows.append((*place, *_outcome(study, trial)))
    short = [name.rpartition(".")[2] for name in names]
    columns = [s if short.count(s) == 1 else n for s, n in zip(short, names, strict=True)]
    head = ("trial", "pipeline", *columns, "seed", "state", "epochs", study.definition.study.result)
    wraps = {name for name, *texts in zip(head, *rows, strict=True) if " " in "".join(texts)}
    bars = _room([head, *rows])
    curves = [spark_line(list(numbers_of(study, trial).values()), bars) for trial in trials]
    lines = [(*row, curve) for row, curve in zip(rows, curves, strict=True)]
    show_table((*head, ""), lines, numbers=set(head) - wraps - {"pipeline", "state"}, curve="")
    show()
    for line in summary(study):
        show(line)


def summary(study: Study) -> Iterator[str]:
    """Yield lines with the number of trials in each state and the best setting."""
    states = [result.state for result in study.results.values()]
    counts = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    left = len(study.trials) - len(states)
    counts += [f"{left} without a result"] if left else []
    yield f"trials: {', '.join(counts) or 'none'}"
    best = study.best()
    if best is not None:
        yield f"best{_MARK}: {_describe(study, best)}"
        yield from (f"session: {study.folder_of(trial)}" for trial in best.trials)


def _describe(study: Study, best: Best) -> str:
    first, count = best.trials[0], len(best.trials)
    settings = describe_trial(first).rpartition(", seed ")[0]
    mean = f", mean of {count} seeds" if count > 1 else f" (seed {first.seed})"
    return f"{settings}: {study.definition.study.result} {best.value:.6g}{mean}"


def _room(rows: Sequence[Sequence[str]]) -> int:
    """Return how many bars fit next to the columns of a table."""
    words = ((len(w) for t in column for w in t.split()) for column in zip(*rows, strict=True))
    taken = sum(max(column) + _GAP for column in words)
    return min(max(width() - taken, 1), _BARS)


def _outcome(study: Study, trial: Trial) -> tuple[str, str, str]:
    """Return the state, epochs and result of a trial."""
    result, numbers = study.results.get(trial.number), numbers_of(study, trial)
    if result is not None:
        epochs = "" if result.epochs is None else str(result.epochs)
        value = result.error if math.isnan(result.value) else f"{result.value:.5g}"
        return result.state, epochs, value
    state = "running" if study.is_running(trial) else "interrupted" if numbers else "waiting"
    return state, str(max(numbers, default=0)), ""


def numbers_of(study: Study, trial: Trial) -> dict[int, float]:
    """Return the numbers to compare of a trial, by epoch; empty if there are none yet."""
    try:
        series = read_scalars(study.folder_of(trial))
    except SessionError:
        return {}
    return dict(sorted(series.get(("epoch", study.definition.study.result), {}).items()))


def record_curves(study: Study, reference: str) -> Sequence[str]:
    """Send all numbers that the trials recorded each epoch to a visualizer, as one run.

    Args:
        study: The study.
        reference: The visualizer, for example ``rerun``.

    Returns:
        Where the visualizer put its output.

    Raises:
        PhysxError: If there is no such visualizer, or it cannot start.
        StudyError: If no trial has recorded a number yet.
    """
    curves: dict[int, dict[str, float]] = {}
    for _, trial in sorted(study.trials.items()):
        try:
            series = read_scalars(study.folder_of(trial))
        except SessionError:
            continue
        for (timeline, name), steps in series.items():
            for step, value in steps.items() if timeline == "epoch" else ():
                curves.setdefault(step, {})[f"{name}/{trial.name}"] = value
    if not curves:
        raise StudyError(f"No trial of {study.folder} has recorded a number yet.")
    visualizer = plugins.resolve("visualizer", reference)()
    visualizer.open(study.definition.name, study.folder, 0)
    try:
        for step, values in sorted(curves.items()):
            visualizer.scalars(values, step, "epoch")
        for line in summary(study):
            visualizer.note(line)
    finally:
        visualizer.close()
    return visualizer.outputs()


def draw_figure(study: Study, path: Path) -> None:
    """Plot the results of the trials in order, and over the values of each parameter.

    Args:
        study: The study.
        path: File to write, for example ``.png`` or ``.svg``.

    Raises:
        MissingLibraryError: If Matplotlib is not installed.
        StudyError: If no trial has a result.
        UsageError: If the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingLibraryError("A figure", "matplotlib", "figure", "physx-cluster") from None
    done = {
        number: study.results[number].value
        for number in sorted(study.results)
        if study.results[number].state in (COMPLETE, PRUNED)
        and math.isfinite(study.results[number].value)
    }
    if not done:
        raise StudyError(f"No trial of {study.folder} has a result yet.")
    names = study.definition.columns
    figure = Figure(figsize=(5.0 * (1 + len(names)), 4.0), layout="constrained")
    first, *others = figure.subplots(1, 1 + len(names), squeeze=False, sharey=True)[0]
    _draw_progress(first, study, done)
    for axes, name in zip(others, names, strict=True):
        _draw_parameter(axes, study, done, name)
    if all(value > 0 for value in done.values()) and max(done.values()) > 10 * min(done.values()):
        for axes in (first, *others):
            axes.set_yscale("log")
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise UsageError(f"The figure {path} cannot be written: {error}.") from None


def _draw_progress(axes: Any, study: Study, done: dict[int, float]) -> None:
    sign, best, so_far = study.definition.sign, math.inf, []
    for value in done.values():
        best = min(best, sign * value)
        so_far.append(sign * best)
    _scatter(axes, study, list(done), list(done.values()), list(done))
    axes.step(list(done), so_far, where="post", color="0.5", label="best so far")
    axes.set(xlabel="trial", ylabel=study.definition.study.result)
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend()


def _draw_parameter(axes: Any, study: Study, done: dict[int, float], name: str) -> None:
    numbers = [number for number in done if name in study.trials[number].values]
    values = [study.trials[number].values[name] for number in numbers]
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        places: list[Any] = values
        known = [each.parameters.get(name) for each in study.definition.pipelines.values()]
        is_log = any(isinstance(each, Range) and each.log for each in known)
        if is_log or (min(values) > 0 and max(values) > 30 * min(values)):
            axes.set_xscale("log")
    else:
        places = [_text(value) for value in values]
    _scatter(axes, study, places, [done[number] for number in numbers], numbers)
    axes.set(xlabel=name)


def _scatter(
    axes: Any, study: Study, places: list[Any], values: list[float], numbers: list[int]
) -> None:
    """Draw a point for each trial, filled if it is complete, in the color of its pipeline."""
    for place, pipeline in enumerate(study.definition.pipelines):
        for state in (COMPLETE, PRUNED):
            chosen = [
                each
                for each, number in enumerate(numbers)
                if study.trials[number].pipeline == pipeline
                and study.results[number].state == state
            ]
            if chosen:
                color = f"C{place}"
                axes.scatter(
                    [places[each] for each in chosen],
                    [values[each] for each in chosen],
                    edgecolors=color,
                    facecolors=color if state == COMPLETE else "none",
                    label=pipeline if state == COMPLETE else f"{pipeline}, pruned",
                )


def _text(value: Any) -> str:
    if value is None:
        return ""
    return (
        f"{value:.4g}"
        if isinstance(value, float)
        else value
        if isinstance(value, str)
        else json.dumps(value)
    )
