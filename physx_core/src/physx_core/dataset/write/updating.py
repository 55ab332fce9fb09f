"""Updates rows in place, in the files that hold them."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.write.row_validation import check_rows
from physx_core.errors import FieldShapeError, MissingFieldError
from physx_core.fields import Field
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
        raise MissingFieldError("No field to update is given.")
    unknown = [name for name in values if name not in fields]
    if unknown:
        check_names(fields, unknown)
    given = {name: fields[name] for name in values}
    if single:
        values = {name: field.convert(values[name])[None] for name, field in given.items()}
    rows, count = check_rows(given, values)
    if count != len(index):
        raise FieldShapeError(f"{count} rows are given, but {len(index)} are selected.")
    return rows


def update_rows(
    store: ManifestStore, mode_name: str, index: Index, rows: Batch, *, durable: bool
) -> None:
    """Overwrite rows; sealed partitions lose their checksums until the dataset is closed.

    Args:
        store: The dataset's manifest.
        mode_name: Name of the mode.
        index: Numbers of the rows, all in range.
        rows: Field name to new rows, checked.
        durable: Whether to wait for the disk.
    """
    mode = store.manifest.modes[mode_name]
    starts = np.cumsum([0, *(partition.rows for partition in mode.partitions)])
    owners = np.searchsorted(starts, index, side="right") - 1
    touched = [mode.partitions[owner] for owner in np.unique(owners)]
    _invalidate(store, mode_name, touched)
    for place in map(mode.place, touched):
        partition = mode.partitions[place]
        here = np.flatnonzero(owners == place)
        for name, block in rows.items():
            path, offset = partition.path(store.directory, name), partition.offsets.get(name)
            if offset is None or not (partition.sealed or partition.writing):
                offset = partition.inspect(store.directory, mode.fields[name]).data_offset
            _write(path, offset, index[here] - starts[place], block[here], durable=durable)


def _invalidate(store: ManifestStore, mode_name: str, touched: list[Partition]) -> None:
    """Drop, before anything is written, the checksums and statistics of the rows."""
    mode = store.manifest.modes[mode_name]
    for partition in touched:
        partition.running = {}
    if any(partition.checksums or partition.counted for partition in touched):
        with store.change() as manifest:
            mode = manifest.modes[mode_name]
            if any(partition.counted for partition in touched):
                mode.forget_statistics()
            for partition in touched:
                mode.swap(replace(partition, checksums={}, counted=False))
    store.manifest.generation += 1


def _write(path: Path, offset: int, places: Index, rows: Array, *, durable: bool) -> None:
    """Write rows to places counted from `offset`, consecutive ones at once."""
    row_nbytes = rows[:1].nbytes
    descriptor = files.open_regular(path, os.O_WRONLY)
    try:
        for first, last in _runs(places) if row_nbytes else ():
            place = offset + int(places[first]) * row_nbytes
            files.write_at(descriptor, files.as_bytes(rows[first:last]), place)
        if durable:
            os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _runs(places: Index) -> Iterator[tuple[int, int]]:
    """Yield where runs of consecutive places begin and end."""
    ends = np.flatnonzero(np.diff(places) != 1) + 1
    bounds = [0, *ends.tolist(), len(places)]
    yield from itertools.pairwise(bounds)
