"""``physx export``: write a dataset as a file or folder of another format."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from physx_core.cli import count, options_from, show
from physx_core.dataset import EPISODES, Dataset
from physx_core.observers import ProgressBar
from physx_formats import ExportOptions, export
from physx_formats.cli.pairs import parse_pairs
from physx_formats.format import LOSSES, Format, find_format
from physx_formats.table import is_picture


@dataclass
class Export:
    """Write a dataset's samples as one file or folder of another format.

    npz: NumPy. hdf5-single: one plain HDF5 file with MODE/FIELD. parquet: columns, for pandas,
    polars, and databases. csv: text. safetensors: arrays. zarr: chunked arrays, for xarray.
    vtkhdf: a mesh and its fields over time, for ParaView. minari: episodes for offline
    reinforcement learning. lerobot: episodes for imitation learning, in version 3 of LeRobot's
    format; its observations that are pictures become videos.
    """

    directory: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="DIR")]
    """A session's or a dataset's folder."""
    out: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="OUT")]
    """The file to create, or the folder for zarr, minari, and lerobot."""
    to: str
    """The format: "npz", "parquet", "csv", "safetensors", "vtkhdf", "minari", "lerobot", "zarr",
    "hdf5-single", or one of another plugin."""
    mode: tuple[str, ...] = ()
    """Modes to export; by default all that have samples. Parquet, csv, vtkhdf, minari, and lerobot
    take one."""
    compression: str = "none"
    """npz: deflate; parquet: snappy, gzip, zstd, lz4, brotli; zarr: zstd, gzip, blosc;
    hdf5-single: gzip, lzf."""
    observations: tuple[str, ...] = ()
    """minari, lerobot: observation fields; by default all training fields not used otherwise. A
    single field is the observation itself."""
    actions: tuple[str, ...] = ()
    """minari, lerobot: action fields; by default minari gets one action without effect."""
    rewards: str | None = None
    """minari, lerobot: reward field; by default minari's rewards are 0."""
    fps: int | None = None
    """lerobot, vtkhdf: frames per second of simulated time; required for lerobot."""
    task: str | None = None
    """lerobot: description of the task."""
    features: Annotated[
        tuple[str, ...], tyro.conf.arg(name="as", metavar="[FEATURE=FIELDS ...]")
    ] = ()
    """lerobot: fields of features, separated by commas: observation.state=q,v
    observation.images.top=camera. Other observations are then those that are named only."""
    points: str | None = None
    """vtkhdf: field with the positions of the mesh's points, of samples or episodes; required."""
    cells: str | None = None
    """vtkhdf: field with the numbers of each cell's points; by default each point is a cell."""
    cell_type: str | None = None
    """vtkhdf: type of the cells, such as "quad"; by default after their number of points."""


def run(words: Sequence[str]) -> None:
    """Export a dataset and print the number of exported samples."""
    options = options_from(Export, words, "export")
    form = ExportOptions(
        options.compression,
        options.observations,
        options.actions,
        options.rewards,
        options.fps,
        options.task,
        {name: of.split(",") for name, of in parse_pairs("as", options.features).items()},
        options.points,
        options.cells,
        options.cell_type,
    )
    bar = ProgressBar()
    with Dataset.open(options.directory) as dataset:
        sizes = {row["mode"]: 0 for row in dataset.describe()}
        for row in dataset.describe():
            sizes[row["mode"]] += row["bytes"]
        wanted = options.mode or sizes
        bar.begin("export", sum(sizes.get(mode, 0) for mode in wanted), "B")
        try:
            written = export(
                dataset,
                options.to,
                options.out,
                modes=options.mode,
                options=form,
                advance=bar.advance,
            )
        finally:
            bar.end()
        stored = {mode: dataset.num_samples(mode) for mode in written}
        if dataset.has_episodes and EPISODES in stored:
            stored[EPISODES] = written[EPISODES]
        lost = _lost(find_format(options.to), dataset, written)
    for mode, rows in written.items():
        show(f"{count(rows, f'{mode} sample')}: {options.out}")
        if rows < stored[mode]:
            left = stored[mode] - rows
            show(f"left out: {left:,} samples in trajectories of a single sample")
    for name in lost:
        show(f"{options.to} {LOSSES[name]}")


def _lost(form: Format, dataset: Dataset, modes: Iterable[str]) -> list[str]:
    """Return what a format does not keep, of `LOSSES`, of what the modes of a dataset have."""
    has_pictures = any(is_picture(of) for mode in modes for of in dataset.fields(mode).values())
    has = {"records": dataset.has_episodes, "colors": has_pictures}
    return [name for name in form.loses if has.get(name, True)]
