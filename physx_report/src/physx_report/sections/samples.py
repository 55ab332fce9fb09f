"""The section on what a data generation has simulated."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from physx_core import Dataset, Result
from physx_core.dataset import EPISODES, EpisodeStatus
from physx_core.errors import PhysxError
from physx_core.pipelines import Redrawing
from physx_report import drawing, wording
from physx_report.blocks import Block, Figure, Picture, Table, Text
from physx_report.film import MOST, as_file, redraw
from physx_report.run import Run
from physx_report.section import Section

_FEW = 10
_MOST = 12
"""Largest number of parameters that are drawn, of fields of an episode, and of reasons."""
_RECORDS = {"mode_index", "campaign", "episode", "count", "first_row", "rows", "part", "status"}


def _blocks(run: Run) -> Iterator[Block]:
    result, dataset = run.results.get("data_generation"), run.dataset
    if result is None or dataset is None:
        return
    yield Text([*result.summary, *_rates(result)], "verdict")
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
        yield from _failures(dataset, modes)
    for mode in modes[:1]:
        yield from _film(run, dataset, mode)
        yield from _distributions(dataset, mode)


def _rates(result: Result) -> list[str]:
    """Say how fast the simulation was."""
    rate = result.numbers.get("generated samples per s")
    return [] if rate is None else [f"{rate:,.3g} samples per s, on the machine of the run"]


def _failures(dataset: Dataset, modes: list[str]) -> Iterator[Block]:
    """Say why episodes have failed."""
    reasons: dict[str, list[str]] = {}
    for mode in modes:
        for each in dataset.failed_episodes(mode):
            reason = each.reason.partition("\n")[0] or "unknown"
            reasons.setdefault(reason, []).append(str(each.episode))
    ordered = sorted(reasons.items(), key=lambda item: -len(item[1]))
    rows = [
        [reason, f"{len(numbers):,}", ", ".join(numbers[:_FEW]) + ", ..." * (len(numbers) > _FEW)]
        for reason, numbers in ordered[:_MOST]
    ]
    left = f"; {len(ordered) - _MOST} other reasons" if len(ordered) > _MOST else ""
    if rows:
        yield Table(["reason", "episodes", "which"], rows, f"Failed episodes{left}")


def _film(run: Run, dataset: Dataset, mode: str) -> Iterator[Block]:
    """Show the first rows as their environment draws them."""
    rows, told = _first_rows(dataset, mode)
    try:
        with (
            warnings.catch_warnings(action="ignore"),  # of environments that draw nothing
            Redrawing(dataset, mode, trust=run.trust) as simulation,
        ):
            film = redraw(simulation, rows, {}, {}, {})
            if not any(film.frames):
                return
            pictures = film.pictures(run.camera, range(len(rows)))
        yield Picture(as_file(pictures), f"{told}, as the environment draws them")
    except PhysxError as error:
        yield Text([f"There are no pictures: {str(error).rstrip('.')}."])


def _first_rows(dataset: Dataset, mode: str) -> tuple[list[int], str]:
    """Return the rows of the first episode, or the first ones of a stream, and what they are."""
    count, known = dataset.num_samples(mode), dataset.recorded_episodes(mode)
    if known is not None and len(known.rows) and known.rows.max() > 1:
        first = int(np.flatnonzero(known.rows > 1)[0])
        begin, size = int(known.first[first]), int(known.rows[first])
        if known.numbers[first] == 1 and known.episode[first] >= 0:
            chosen = np.unique(np.linspace(begin, begin + size - 1, MOST).astype(int)).tolist()
            told = f"{len(chosen)} of {size} rows" if len(chosen) < size else f"{size} rows"
            return chosen, f"Episode {int(known.episode[first])}, {told}"
    some = np.arange(min(count, 16 * MOST))
    if "env_id" in dataset.fields(mode):
        owners = np.asarray(dataset[mode]["env_id"][: len(some)])
        some = some[owners == owners[0]]
    chosen = some[:MOST].tolist()
    return chosen, f"The first {len(chosen)} rows of an instance"


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
        yield _histograms(shown, "How often parameters, and durations in s, occurred", "episodes")


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
        told = f"Values of {len(chosen):,} of {count:,} samples"
        yield _histograms(flat, f"{told}, at equal distances", "values")
        rows = [
            [name, *map(wording.number, (v.mean(), v.std(), v.min(), v.max()))]
            for name, v in flat.items()
        ]
        yield Table(["field", "mean", "deviation", "smallest", "largest"], rows, told)


def _histograms(values: dict[str, np.ndarray], caption: str, what: str) -> Figure:
    columns = min(4, len(values))
    rows = -(-len(values) // columns)
    with drawing.figure(caption, rows, columns, height=1.7) as (found, axes):
        for place, (name, each) in zip(axes, values.items(), strict=False):
            place.hist(each, bins=min(30, max(5, len(each) // 10)), color=drawing.MUTED)
            place.set_xlabel(name)
        for place in axes[len(values) :]:
            place.set_axis_off()
        for place in axes[::columns]:
            place.set_ylabel(what)
    return found[0]


SECTION = Section("What was simulated", _blocks, 40)
