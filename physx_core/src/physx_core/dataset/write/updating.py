"""Updates rows in place in the partition files."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from physx_core import files
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.partition.spans import FlatIndex
from physx_core.dataset.store.sealing import unseal
from physx_core.dataset.write.row_validation import check_rows
from physx_core.errors import DatasetError, FieldShapeError, MissingFieldError
from physx_core.fields import ENDS, Field, free_axes
from physx_core.packing import ranges
from physx_core.rows import check_names
from physx_core.typing import Array, Batch, Index


def check_update(
    fields: Mapping[str, Field], index: Index, values: Mapping[str, Any], *, single: bool
) -> Batch:
    """Return the new values of some fields as contiguous rows of the fields' types.

    Args:
        fields: The fields of the mode.
        index: Numbers of the rows.
        values: Field name to rows; to one value if `single`.
        single: Whether the index was a single number.
    """
    if not values:
        raise MissingFieldError("No fields to update are given.")
    unknown = [name for name in values if name not in fields]
    if unknown:
        check_names(fields, unknown)
    given = {name: fields[name] for name in values}
    if single:
        values = {
            name: [found] if field.free_axis else found[None]
            for name, field in given.items()
            for found in [field.convert(values[name])]
        }
    rows, count = check_rows(given, values)
    if count != len(index):
        raise FieldShapeError(f"{count} rows are given, but {len(index)} are selected.")
    return rows


class Opened(Protocol):
    """The partition that is being written."""

    partition: Partition

    def settle(self, names: Iterable[str], last: int) -> None:
        """Prepare some fields for an update of rows up to `last`."""


def check_unchanged(fields: Mapping[str, Field], rows: Batch, sizes: Mapping[str, Index]) -> None:
    """Check that rows keep the sizes of their free axes.

    Args:
        fields: The fields of the mode.
        rows: The new rows, as they are stored.
        sizes: How many entries the rows have, by free axis.

    Raises:
        FieldShapeError: If one has other sizes.
    """
    for axis, names in free_axes(fields[name] for name in rows if name in fields).items():
        given = np.diff(rows[axis + ENDS].astype(np.intp), prepend=0)
        wrong = np.flatnonzero(given != sizes[axis])
        if len(wrong):
            row = wrong[0]
            raise FieldShapeError(
                f'Row {row} of the update has {given[row]} entries on the axis "{axis}", but '
                f"{sizes[axis][row]} are stored. Rows keep their sizes: append new ones.",
                field=names[0],
            )


def update_rows(
    store: ManifestStore,
    mode_name: str,
    index: Index,
    rows: Batch,
    opened: Opened | None,
    bounds: Mapping[str, Index],
) -> set[Path]:
    """Overwrite rows; sealed partitions lose their checksums until the dataset is closed.

    Args:
        store: The dataset's manifest.
        mode_name: Name of the mode.
        index: Numbers of the rows, all in range.
        rows: Field name to new rows, checked.
        opened: The partition of the mode that is being written.
        bounds: First stored entry of each row of the mode, and the end, by free axis.

    Returns:
        The files that were written to.
    """
    mode = store.manifest.modes[mode_name]
    spans = mode.spans
    owners, rows_there = FlatIndex(spans).locate(index)
    touched = [mode.partitions[owner] for owner in np.unique(owners)]
    _invalidate(store, mode_name, touched)
    updated = set()
    for place in map(mode.place, touched):
        partition = mode.partitions[place]
        here = np.flatnonzero(owners == place)
        places = rows_there[here]
        if opened is not None and partition is opened.partition:
            opened.settle([name for name in rows if name not in mode.ends], int(places.max()))
        elif not partition.sealed:
            raise DatasetError(
                f"Partition {partition.index} of mode {mode_name!r} could not be sealed. Free some "
                "disk space and reopen the dataset before you update its rows."
            )
        for name, block in rows.items():
            if name in mode.ends:
                continue  # the ends stay
            path, axis = partition.path(store.directory, name), mode.fields[name].free_axis
            updated.add(path)
            if not axis:
                _write(path, partition.offsets[name], places, block[here])
                continue
            known, ends = bounds[axis], rows[axis + ENDS].astype(np.intp)
            begins = known[spans[place].start + places] - known[spans[place].start]
            counts = known[spans[place].start + places + 1] - known[spans[place].start + places]
            entries = ranges(ends[here] - counts, counts)
            _write(path, partition.offsets[name], ranges(begins, counts), block[entries])
    return updated


def _invalidate(store: ManifestStore, mode_name: str, touched: list[Partition]) -> None:
    """Drop the checksums and statistics of the rows before anything is written."""
    for partition in touched:
        partition.running = {}
    sealed = [partition for partition in touched if partition.checksums or partition.counted]
    if sealed:
        with store.change() as manifest:
            mode = manifest.modes[mode_name]
            if any(partition.counted for partition in sealed):
                mode.forget_statistics()
            for partition in sealed:
                mode.swap(unseal(store.directory, mode.fields, partition))
    store.manifest.generation += 1


def _write(path: Path, offset: int, places: Index, rows: Array) -> None:
    """Write rows to places counted from `offset`, each consecutive run at once."""
    row_nbytes = rows[:1].nbytes
    with files.opened(path, os.O_WRONLY) as descriptor:
        for first, last in _runs(places) if row_nbytes else ():
            place = offset + int(places[first]) * row_nbytes
            files.write_at(descriptor, files.as_bytes(rows[first:last]), place)


def _runs(places: Index) -> Iterator[tuple[int, int]]:
    """Yield the start and end of each run of consecutive places."""
    ends = np.flatnonzero(np.diff(places) != 1) + 1
    bounds = [0, *ends.tolist(), len(places)]
    yield from itertools.pairwise(bounds)
