"""The section on what a data generation has simulated."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from physx_core import Dataset
from physx_core.dataset import EPISODES, EpisodeStatus
from physx_report import drawing, wording
from physx_report.blocks import Block, Figure, Table, Text
from physx_report.run import Run
from physx_report.section import Section

_MOST = 12
"""Largest number of parameters that are drawn, and of fields of an episode."""
_RECORDS = {"mode_index", "campaign", "episode", "count", "first_row", "rows", "part", "status"}


def _blocks(run: Run) -> Iterator[Block]:
    result, dataset = run.results.get("data_generation"), run.dataset
    if result is None or dataset is None:
        return
    yield Text(list(result.summary), "verdict")
    modes = [mode for mode in dataset.modes if mode != EPISODES and dataset.num_samples(mode)]
    rows = [
        [
            mode,
            name,
            str(field.shape),
            str(field.dtype),
            field.unit,
            f"{dataset.num_samples(mode):,}",
        ]
        for mode in modes
        for name, field in dataset.fields(mode).items()
    ]
    yield Table(["mode", "field", "shape", "type", "unit", "samples"], rows, "Samples")
    if EPISODES in dataset.modes:
        yield from _campaign(dataset, modes)
    for mode in modes[:1]:
        yield from _distributions(dataset, mode)


def _campaign(dataset: Dataset, modes: list[str]) -> Iterator[Block]:
    """Say how the episodes ended, and where their parameters were."""
    table = dataset.episode_table(modes)
    known = table["episode"] >= 0
    names = {int(status): status.name.lower() for status in EpisodeStatus}
    status, counts = np.unique(table["status"][known], return_counts=True)
    rows = [
        [names.get(int(one), str(one)), f"{count:,}"]
        for one, count in zip(status, counts, strict=True)
    ]
    yield Table(["ended", "episodes"], rows, "Episodes")
    values = {
        name: column[known]
        for name, column in table.items()
        if name not in _RECORDS and column.ndim == 1 and column.dtype.kind == "f"
    }
    values = {n: v[np.isfinite(v)] for n, v in values.items() if np.isfinite(v).sum() > 1}
    shown = dict(list(values.items())[:_MOST])
    if shown:
        yield _histograms(shown, "How often parameters, and durations in s, occurred")


def _distributions(dataset: Dataset, mode: str) -> Iterator[Block]:
    """Show how the values of fields are distributed, from rows at equal distances."""
    count = dataset.num_samples(mode)
    chosen = np.unique(np.linspace(0, count - 1, min(count, 2000)).astype(int))
    fields = [
        name
        for name, field in dataset.fields(mode).items()
        if field.has_statistics and name not in ("env_id", "episode", "step")
    ][:_MOST]
    values = {name: np.asarray(dataset[mode][name][chosen]) for name in fields}
    flat = {name: each[np.isfinite(each)].ravel() for name, each in values.items()}
    flat = {name: each for name, each in flat.items() if len(each)}
    if flat:
        yield _histograms(flat, f"Values of {len(chosen):,} samples")
        rows = [
            [name, *map(wording.number, (v.mean(), v.std(), v.min(), v.max()))]
            for name, v in flat.items()
        ]
        yield Table(["field", "mean", "deviation", "smallest", "largest"], rows, "Values")


def _histograms(values: dict[str, np.ndarray], caption: str) -> Figure:
    columns = min(4, len(values))
    rows = -(-len(values) // columns)
    with drawing.figure(caption, rows, columns, height=1.7) as (found, axes):
        for place, (name, each) in zip(axes, values.items(), strict=False):
            place.hist(each, bins=min(30, max(5, len(each) // 10)), color=drawing.MUTED)
            place.set_xlabel(name)
        for place in axes[len(values) :]:
            place.set_axis_off()
    return found[0]


SECTION = Section("What was simulated", _blocks, 40)
