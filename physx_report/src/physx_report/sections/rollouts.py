"""The section on what becomes of predictions that are fed back."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from physx_core.pipelines import Redrawing, trace_episode
from physx_core.results import RolloutResult, rollout_notes
from physx_report import drawing, wording
from physx_report.blocks import Block, Picture, Table, Text
from physx_report.film import MOST, as_file, or_why_not, redraw
from physx_report.run import Run
from physx_report.section import Section


def _blocks(run: Run) -> Iterator[Block]:
    result = run.results.get("evaluation")
    if result is None or result.policies:
        return
    yield Text(list(result.summary))
    for name, rollout in result.rollouts.items():
        yield from _rollout(name, rollout)
        if name == next(iter(result.rollouts)):
            yield from or_why_not(_film(run, rollout))


def _rollout(name: str, of: RolloutResult) -> Iterator[Block]:
    notes = [f"{name}: {note}." for note in rollout_notes(of)]
    yield Text(notes, "verdict")
    several = "," in of.unit
    unit = "std" if several else of.unit
    caption = (
        f"{name}. Error of predictions that are fed back, by row after the beginning of "
        f"{of.episodes} episodes ({of.part}); area: 80 % of the episodes"
    )
    with drawing.figure(caption, height=3.0) as (found, (axes,)):
        axes.fill_between(of.rows, of.low, of.high, color=drawing.MUTED, alpha=0.3, lw=0)
        axes.plot(of.rows, of.errors, color=drawing.PREDICTION, label="predictions fed back")
        axes.plot(of.rows, of.unchanged, color=drawing.TRUTH, ls=":", label="nothing changes")
        axes.set_xlabel("row")
        axes.set_ylabel(f"error{f' / {unit}' if unit else ''}")
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False)
    yield from found
    columns = of.errors, of.low, of.high, of.unchanged
    rows = [[f"{of.rows[k]:,}", *(wording.number(each[k]) for each in columns)] for k in of.shown]
    head = ["row", "error", "a tenth of the episodes below", "a tenth above", "nothing changes"]
    yield Table(head, rows, f"{name}{f' / {unit}' if unit else ''}")
    if of.episode_errors:
        rows = [
            [which, each.text, wording.measured("rmse", each.error, of.unit)]
            for which, each in of.episode_errors.items()
        ]
        yield Table(["", "episode", "error of all rows"], rows, f"{name}, by episode")
    for label, drift in of.invariants.items():
        if not drift.prediction:
            continue
        caption = f"{label}. How far it moves from its value at the beginning, on average"
        with drawing.figure(caption) as (found, (axes,)):
            axes.plot(of.rows[: len(drift.prediction)], drift.prediction,
                      color=drawing.PREDICTION, label="predictions fed back")  # fmt: skip
            axes.plot(of.rows[: len(drift.truth)], drift.truth, color=drawing.TRUTH,
                      label="simulation")  # fmt: skip
            axes.set_xlabel("row")
            axes.set_ylabel(label)
            axes.legend(frameon=False)
        yield from found


def _film(run: Run, of: RolloutResult) -> Iterator[Block]:
    """Yield a film of the median episode."""
    episode, unseen = of.episode_errors.get("median"), run.unseen
    if episode is None or unseen is None or of.part not in unseen.parts:
        return
    batches = unseen.parts[of.part]
    [dataset] = batches.datasets.values()
    found = trace_episode(unseen, of.part, episode)
    shown = np.unique(np.linspace(0, len(found.rows) - 1, MOST).astype(int))
    rows = [found.rows[k] for k in shown]
    truth, prediction = (
        {name: values[shown] for name, values in each.items()}
        for each in (found.truth, found.prediction)
    )
    with Redrawing(dataset, batches.mode, trust=run.trust) as drawing:
        film = redraw(drawing, rows, truth, prediction, {})
    if film.look:
        pictures = film.pictures(run.camera, range(len(rows)))
        told = f"{len(rows)} of {len(found.rows):,} rows, predicted from the first"
        about = f"Film of the median episode, {episode.text} ({of.part}; {told})"
        yield Picture(as_file(pictures), f"{about}; {film.look}")


SECTION = Section("What becomes of it over time", _blocks, 15)
