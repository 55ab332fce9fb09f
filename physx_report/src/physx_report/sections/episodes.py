"""The section on errors by step and by parameter, and on the best and the worst episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from physx_core import Batches
from physx_core.errors import PhysxError
from physx_core.fields import PTR
from physx_core.pipelines import Unseen
from physx_core.results import EpisodeError, FieldResult, PartResult
from physx_core.typing import Array
from physx_report import drawing, wording
from physx_report.blocks import Block, Text
from physx_report.run import Run
from physx_report.section import Section

_MOST_BATCHES = 64
_ROWS = 400
"""Largest number of rows of an episode that are drawn."""
_ORDER = ("best", "median", "worst")


def _blocks(run: Run) -> Iterator[Block]:
    try:
        unseen = run.unseen
    except PhysxError as error:
        yield Text([f"The network cannot be run on its samples any more: {error}"])
        return
    if unseen is None or run.training is None:
        return
    for name, part in run.training.parts.items():
        if name in unseen.parts:
            yield from _errors(unseen, name)
            yield from _pictures(unseen, name, part)


def _errors(unseen: Unseen, part: str) -> Iterator[Block]:
    """Draw errors against the step, and against the parameters of episodes."""
    batches = unseen.parts[part]
    count = min(len(batches), _MOST_BATCHES)
    chosen = np.unique(np.linspace(0, len(batches) - 1, count).astype(int)).tolist()
    groups = np.concatenate([batches.groups(number) for number in chosen])
    squares: dict[str, list[Array]] = {}
    for number in chosen:
        batch = batches[number]
        predicted, true = unseen.compare(batch)
        for name, values in predicted.items():
            if values.dtype.kind == "f":
                error = (values - true[name]).astype(np.float64).reshape(len(values), -1)
                square = (error**2).mean(axis=1)
                if axis := batches.fields[name].free_axis:
                    square = _by_item(square, batch[axis + PTR])
                squares.setdefault(name, []).append(square)
    known, place = np.unique(groups, return_inverse=True)
    about = [batches.describe_group(int(group)) for group in known]
    step = np.concatenate([batches.rows(number)[0] for number in chosen])
    step = step - np.array([one["first_row"] for one in about])[place]
    for name, parts in squares.items():
        square, unit = np.concatenate(parts), batches.fields[name].unit
        label = f"{name}: error{f' / {unit}' if unit and ',' not in unit else ''}"
        yield from _by_step(name, label, step, square, part)
        by_episode = np.sqrt(np.bincount(place, square) / np.bincount(place))
        yield from _by_parameter(name, label, about, by_episode, part)


def _by_item(values: Array, ptr: Array) -> Array:
    """Return the mean of each item's values, which are joined end to end; NaN if it has none."""
    sums = np.diff(np.concatenate([[0.0], np.cumsum(values)])[ptr])
    return np.asarray(sums / np.where(np.diff(ptr), np.diff(ptr), np.nan))


def _by_step(name: str, label: str, step: Array, square: Array, part: str) -> Iterator[Block]:
    if len(np.unique(step)) < 3 or step.min() < 0:
        return
    edges = np.unique(np.linspace(0, step.max() + 1, 41).astype(int))
    where = np.digitize(step, edges) - 1
    filled = [k for k in range(len(edges) - 1) if (where == k).any()]
    root = np.sqrt(square)
    quantiles = np.array([np.quantile(root[where == k], (0.1, 0.5, 0.9)) for k in filled])
    x = edges[filled]
    with drawing.figure(f"{name}. Error by step of the episode ({part})") as (found, (axes,)):
        axes.fill_between(x, quantiles[:, 0], quantiles[:, 2], color=drawing.MUTED, alpha=0.3, lw=0)
        axes.plot(x, quantiles[:, 1], color=drawing.PREDICTION)
        axes.set_xlabel("step (line: median; area: 80 % of the samples)")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
    yield from found


def _by_parameter(
    name: str, label: str, about: list[dict[str, Any]], errors: Array, part: str
) -> Iterator[Block]:
    parameters = [one.get("parameters", {}) for one in about]
    names = [n for n in (parameters[0] if parameters else {}) if np.ndim(parameters[0][n]) == 0]
    names = [n for n in names if all(isinstance(p.get(n), float) for p in parameters)][:4]
    if not names or len(errors) < 3:
        return
    caption = f"{name}. Error of each episode by parameter ({part})"
    with drawing.figure(caption, 1, len(names)) as (found, axes):
        for place, of in zip(axes, names, strict=True):
            place.plot([p[of] for p in parameters], errors, ".", color=drawing.PREDICTION, ms=5)
            place.set_xlabel(of)
            place.set_ylim(bottom=0)
        axes[0].set_ylabel(label)
    yield from found


def _pictures(unseen: Unseen, part: str, judged: PartResult) -> Iterator[Block]:
    """Draw the best, the median, and the worst episode of each field."""
    batches = unseen.parts[part]
    if len(batches.datasets) > 1 or not len(batches):
        return
    rows = np.concatenate([batches.rows(number)[0] for number in range(len(batches))])
    for name, of in judged.fields.items():
        known = {which: of.episodes[which] for which in _ORDER if which in of.episodes}
        drawn = {
            f"{which.capitalize()} episode: {_described(episode, of)}": pair
            for which, episode in known.items()
            if (pair := _compared(unseen, batches, name, items_of(rows, episode.about)))
        }
        if not drawn:
            continue
        label = f"{name}{f' / {of.unit}' if of.unit and ',' not in of.unit else ''}"
        if batches.fields[name].free_axis:
            caption = f"{name}. Predicted against true values. {'. '.join(drawn)}."
            with drawing.figure(caption, 1, len(drawn), width=9.0, height=3.0) as (found, axes):
                for place, which, pair in zip(axes, known, drawn.values(), strict=False):
                    drawing.scatter(place, *pair, label)
                    place.set_title(which, fontsize=9)
            yield from found
            continue
        if drawing.are_lines(next(iter(drawn.values()))[0]):
            caption = f"{name}. {'. '.join(drawn)}."
            with drawing.figure(caption, 1, len(drawn), width=9.0) as (found, axes):
                for place, which, pair in zip(axes, known, drawn.values(), strict=False):
                    drawing.compare([place], *pair, label, "step")
                    place.set_title(which, fontsize=9)
            yield from found
            continue
        for caption, pair in drawn.items():
            with drawing.figure(f"{name}. {caption}.", 1, 3, width=9.0) as (found, axes):
                drawing.compare(axes, *pair, label, "step")
            yield from found


def _described(episode: EpisodeError, of: FieldResult) -> str:
    return f"{episode.text}, error {wording.measured('rmse', episode.error, of.unit)}"


def _compared(
    unseen: Unseen, batches: Batches, name: str, items: Array
) -> tuple[Array, Array] | None:
    """Return the truth of some items, and what was predicted; None if there are no numbers."""
    if not len(items):
        return None
    predicted, true = unseen.compare(batches.take(items))
    if name not in predicted or true[name].dtype.kind not in "fiub":
        return None
    return true[name].astype(float), predicted[name].astype(float)


def items_of(rows: Array, about: Mapping[str, Any]) -> Array:
    """Return the items of an episode.

    Args:
        rows: The reference rows of all items, in the order of writing.
        about: See `EpisodeError`.
    """
    first, count = about["first_row"], about["rows"]
    return np.flatnonzero((rows >= first) & (rows < first + count))[:_ROWS]


SECTION = Section("Where it is good and where it is bad", _blocks, 20)
