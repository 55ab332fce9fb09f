"""Updating rows in place, in the files where they lie."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physx_core import files
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.partition_format import inspect
from physx_core.dataset.write.checks import check_rows
from physx_core.errors import FieldShapeError, MissingFieldError
from physx_core.fields import Field
from physx_core.rows import check_names
from physx_core.typing import Array, Batch

Index = NDArray[np.intp]


def row_numbers(index: Any, total: int) -> Index:
    """Return the numbers of the rows that a number, a slice or an array stands for.

    Raises:
        IndexError: There are no such rows, or the index is something else.
    """
    if isinstance(index, slice):
        return np.arange(*index.indices(total))
    numbers = np.atleast_1d(np.asarray(index))
    if numbers.dtype.kind == "b" and numbers.shape == (total,):
        return np.flatnonzero(numbers)
    if not numbers.size:
        return np.zeros(0, np.intp)
    if numbers.dtype.kind not in "iu" or numbers.ndim != 1:
        raise IndexError(f"Rows are taken by a number, a slice or an array, not by {index!r}.")
    if numbers.min() < -total or numbers.max() >= total:
        raise IndexError(f"Row numbers are out of range: there are {total} rows.")
    return np.where(numbers < 0, numbers + total, numbers).astype(np.intp)


def checked(
    fields: Mapping[str, Field], index: Index, values: Mapping[str, Any], *, single: bool
) -> Batch:
    """Return the new values of some fields as contiguous rows of the fields' types.

    Args:
        fields: The fields of the mode.
        index: Numbers of the rows.
        values: Field name to rows; to one value if `single`.
        single: Whether the index was a single number.

    Raises:
        SampleError: A field is unknown, or none is given, or its rows do not fit.
    """
    if not values:
        raise MissingFieldError("No field is given whose rows are to be updated.")
    unknown = [name for name in values if name not in fields]
    if unknown:
        check_names(fields, unknown)
    given = {name: fields[name] for name in values}
    if single:
        values = {name: field.convert(values[name])[None] for name, field in given.items()}
    rows, count = check_rows(given, values)
    if count != len(index):
        raise FieldShapeError(f"{count} rows are given for {len(index)} places.")
    return rows


def update_rows(
    store: ManifestStore, mode_name: str, index: Index, rows: Batch, *, durable: bool
) -> None:
    """Write rows over others; sealed partitions lose their checksums until the dataset is closed.

    Args:
        store: What the dataset holds.
        mode_name: Name of the mode.
        index: Numbers of the rows, all in range.
        rows: Field name to new rows, checked.
        durable: Whether to wait for the disk.

    Raises:
        DatasetError: A partition is missing or damaged.
        OSError: The storage fails; rows before may have been updated.
    """
    mode = store.manifest.modes[mode_name]
    starts = np.cumsum([0, *(partition.rows for partition in mode.partitions)])
    owners = np.searchsorted(starts, index, side="right") - 1
    touched = [mode.partitions[owner] for owner in np.unique(owners)]
    _announce(store, mode_name, touched)
    for partition in touched:
        partition = mode.partitions[mode.place(partition)]
        here = np.flatnonzero(owners == mode.place(partition))
        places = index[here] - starts[mode.place(partition)]
        for name, block in rows.items():
            path = store.directory / partition.file_name(mode_name, name)
            offset = _offset(path, partition, mode.fields[name])
            _write(path, offset, places, block[here], durable=durable)


def _announce(store: ManifestStore, mode_name: str, touched: list[Partition]) -> None:
    """Note, before anything is written, that checksums and statistics do not hold any more."""
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
    store.moved = True


def _offset(path: Path, partition: Partition, field: Field) -> int:
    if partition.sealed or partition.writing:
        return partition.offsets[field.name]
    return inspect(path, partition.offsets.get(field.name), field.nbytes).data_offset


def _write(path: Path, offset: int, places: Index, rows: Array, *, durable: bool) -> None:
    """Write rows to places counted from `offset`, those side by side at once."""
    row_nbytes = rows[:1].nbytes
    descriptor = files.open_regular(path, os.O_WRONLY)
    try:
        for first, last in _runs(places) if row_nbytes else ():
            place = offset + int(places[first]) * row_nbytes
            files.write_at(descriptor, files.raw(rows[first:last]), place)
        if durable:
            os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _runs(places: Index) -> Iterator[tuple[int, int]]:
    """Yield where runs of consecutive places begin and end."""
    ends = np.flatnonzero(np.diff(places) != 1) + 1
    bounds = [0, *ends.tolist(), len(places)]
    yield from itertools.pairwise(bounds)
