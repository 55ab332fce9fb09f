"""Exports the rows of a dataset to one file or folder of another format."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from physx_core.dataset import EPISODES, Dataset
from physx_core.errors import ConfigError, PhysxError, listed
from physx_formats.errors import ExchangeError
from physx_formats.format import Format, all_formats, find_format
from physx_formats.table import Advance, ExportOptions, Table, check_new

_OPTIONS = (
    *("observations", "actions", "rewards", "fps", "task", "features"),
    *("points", "cells", "cell_type"),
)


def export(
    dataset: Dataset,
    to: str,
    out: str | Path,
    *,
    modes: Sequence[str] = (),
    options: ExportOptions | None = None,
    advance: Advance = lambda nbytes: None,
) -> dict[str, int]:
    """Write the rows of a dataset in another format, block by block.

    The file or folder appears under its name only when it is complete.

    Args:
        dataset: The dataset.
        to: Name of the format, such as ``npz``, or its reference, such as ``mine/columns``.
        out: The file, or the folder for zarr, minari and lerobot. It must not exist.
        modes: Names of the modes; empty: all that have rows. Parquet, csv, vtkhdf, minari and
            lerobot hold one.
            ``episodes`` are the records of independent episodes, with their parameters: one for
            each, whose ``first_row`` is the number of its first row in its mode. The other formats
            have them beside the rows if no modes are named.
        options: Options of the format.
        advance: Called with the number of bytes read.

    Returns:
        Number of rows written for each mode.

    Raises:
        ComponentNotFoundError: If there is no such format.
        ConfigError: If it has no such compression, or cannot hold several modes.
        ExchangeError: If the format cannot hold a field, or the file cannot be written.
        MissingLibraryError: If the library for the format is not installed.
        DatasetError: If there is no such mode, nothing to write, or a partition is damaged.
    """
    out, options = Path(out), options or ExportOptions()
    form = _choose_format(to, options)
    tables = _make_tables(dataset, modes, advance, with_episodes=form.several)
    _check_tables(to, form, tables)
    check_new(out)
    left_out = _write(form, tables, out, options)
    return {table.mode: table.rows - left_out for table in tables}


def _check_tables(to: str, form: Format, tables: Sequence[Table]) -> None:
    """Check that a format has a place for the fields of some modes."""
    if len(tables) > 1 and not form.several:
        raise ConfigError(
            f"{to} holds one mode. Choose one with modes (--mode on the command line): "
            f"{listed(table.mode for table in tables)}."
        )
    fields = [field for table in tables for field in table.fields.values()]
    free = [field.name for field in fields if field.free_axis]
    if free and not form.free_axes:
        raise ExchangeError(
            f"{to} holds rows of one size, but these fields have a free axis: {listed(free)}. Read "
            "them from the dataset's HDF5 files, or leave them out with `physx edit`."
        )
    texts = [field.name for field in fields if field.is_text]
    if texts and not form.text:
        raise ExchangeError(
            f"{to} holds numbers, but these fields are text: {listed(texts)}. Leave them out with "
            "`physx edit --drop`."
        )


def _write(form: Format, tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write tables to a path; it appears once it is complete. Return how many rows are left out."""
    assert form.write is not None
    try:
        with tempfile.TemporaryDirectory(dir=out.absolute().parent, prefix=".export-") as folder:
            draft = Path(folder) / out.name
            left_out = form.write(tables, draft, options)
            draft.rename(out)
    except PhysxError:
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise ExchangeError(
            f"{out} cannot be written: {reason}. Nothing was left behind."
        ) from error
    return left_out


def _choose_format(to: str, options: ExportOptions) -> Format:
    form = find_format(to)
    if form.write is None:
        raise ConfigError(f'Datasets can be imported from "{to}", but not exported to it.')
    if options.compression not in form.compressions:
        raise ConfigError(
            f'{to} has no compression "{options.compression}". It has: {listed(form.compressions)}.'
        )
    for name in _OPTIONS:
        if getattr(options, name) not in ((), None, {}) and name not in form.options:
            takers = [one for one, known in all_formats().items() if name in known.options]
            raise ConfigError(f"{name} is for {listed(takers)}, not for {to}.")
    if options.fps is not None and options.fps < 1:
        raise ConfigError(f"fps is {options.fps} but must be at least 1 frame per second.")
    return form


def _make_tables(
    dataset: Dataset, modes: Sequence[str], advance: Advance, *, with_episodes: bool
) -> list[Table]:
    samples = [name for name in dataset.modes if dataset.num_samples(name)]
    recorded = [n for n in samples if dataset.recorded_episodes(n) is not None]
    left_out = {EPISODES} if recorded and not with_episodes else set()
    names = modes or [name for name in samples if name not in left_out]
    tables = []
    for name in dict.fromkeys(names):
        if name == EPISODES and recorded:
            tables.append(_make_episodes(dataset, recorded, advance))
            continue
        fields, rows = dataset.fields(name), dataset.num_samples(name)
        if not rows:
            raise ExchangeError(f'Mode "{name}" has no samples to export.')
        tables.append(Table(name, fields, rows, dataset.info, dataset[name], advance))
    if not tables:
        raise ExchangeError(f"The dataset in {dataset.directory} has no samples to export.")
    return tables


def _make_episodes(dataset: Dataset, modes: Sequence[str], advance: Advance) -> Table:
    """Return the records of the episodes of modes, with their parameters."""
    view = dataset.episode_table(modes)
    rows, fields = len(view["rows"]), dataset.fields(EPISODES)
    return Table(EPISODES, fields, rows, dataset.info, view, advance)
