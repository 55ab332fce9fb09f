"""The section on what becomes of predictions that are fed back."""

from __future__ import annotations

from collections.abc import Iterator

from physx_core.results import RolloutResult, rollout_notes
from physx_report import drawing, wording
from physx_report.blocks import Block, Table, Text
from physx_report.run import Run
from physx_report.section import Section


def _blocks(run: Run) -> Iterator[Block]:
    result = run.results.get("evaluation")
    if result is None or result.policies:
        return
    yield Text(list(result.summary))
    for name, rollout in result.rollouts.items():
        yield from _rollout(name, rollout)


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


SECTION = Section("What becomes of it over time", _blocks, 15)
