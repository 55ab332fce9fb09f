"""Caches columns of a dataset that are in memory or mapped, and chooses between memory and disk."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.dataset.read.access import memory
from physx_core.dataset.read.access.disk import DiskColumn
from physx_core.dataset.read.access.mapping import MappedColumn, Runs
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.shuffling import LARGE_ROW
from physx_core.fields import Field
from physx_core.packing import copy_ranges, split
from physx_core.typing import Array, Index


class MemoryColumn:
    """The stored rows of a field in memory, in the requested type; of a free axis, the entries.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the rows.
    """

    def __init__(self, reader: Reader, mode: str, field: Field, dtype: np.dtype[Any]) -> None:
        self.dtype = dtype
        self.shape: tuple[int, ...] = (0, *field.entry_shape)
        self._reader = reader
        self._mode, self._name = mode, field.name
        self._plain = np.dtype(field.dtype) == dtype
        self._array = np.empty(self.shape, dtype)
        self._runs = Runs()

    def check(self) -> None:
        """Check nothing: the rows are in memory, whatever becomes of the files."""

    def extend(self, rows: int) -> None:
        """Read those of the first `rows` rows that are not in memory yet."""
        have = self.shape[0]
        if rows > len(self._array):
            grown = np.empty((max(rows, 2 * have), *self.shape[1:]), self._array.dtype)
            grown[:have] = self._array[:have]
            self._array = grown
        if self._plain:
            self._reader.read_into(self._array[have:rows], self._mode, self._name, have)
        else:
            for block in self._reader.blocks(self._mode, self._name, have, rows):
                self._array[have : have + len(block)] = block
                have += len(block)
        self.shape, self._runs = (rows, *self.shape[1:]), Runs()

    @property
    def array(self) -> Array:
        """The rows, of shape `shape`."""
        return self._array[: self.shape[0]]

    def windows(self, first: Index, count: int) -> Array:
        """Return consecutive rows from each of some rows on, shape (n, count, *field shape)."""
        return (
            self._runs.of(self.array, count)[first]
            .view(self.dtype)
            .reshape(len(first), count, *self.shape[1:])
        )

    def copy(self, starts: Index, counts: Index, out: Array) -> None:
        """Copy runs of rows into an array of as many, at least one: see `copy_ranges`."""
        copy_ranges(self._array, starts, counts, out)

    def gather(self, index: Index, out: Array) -> None:
        """Copy the rows of an index array, all in range, into `out`."""
        # All modes but the default write directly to `out`.
        self._array.take(index, 0, out, "clip")


class ColumnCache:
    """The columns of a dataset by stored row, kept between uses until stored rows change.

    Attributes:
        reader: Reads the rows.
    """

    def __init__(self, reader: Reader) -> None:
        self.reader = reader
        self._generation = reader.manifest.generation
        self._loaded: dict[tuple[str, str, np.dtype[Any]], MemoryColumn] = {}
        self._mapped: dict[tuple[str, str], MappedColumn] = {}

    def open(
        self, mode: str, names: Sequence[str], dtype: np.dtype[Any] | None, *, loads: bool
    ) -> list[MemoryColumn | DiskColumn]:
        """Return fields in memory if they are there, or may be, and else on disk.

        Args:
            mode: Name of the mode.
            names: Names of the fields.
            dtype: Type that floating-point fields are converted to; None: no conversion.
            loads: Whether to read fields into memory, smallest fields first, if they fit there;
                those with large rows only if all fit.
        """
        sizes = {name: self.missing(mode, name, dtype) for name in names}
        left = memory.memory_budget() if loads and any(sizes.values()) else 0
        fits = sum(sizes.values()) <= left
        found: dict[str, MemoryColumn | DiskColumn] = {}
        for name in sorted(names, key=sizes.__getitem__):
            is_small = self.reader.field(mode, name).nbytes < LARGE_ROW
            if sizes[name] <= left and (fits or is_small or not sizes[name]):
                left -= sizes[name]
                found[name] = self.load(mode, name, dtype)
            else:
                self.reader.check(mode, name)
                found[name] = DiskColumn(self.reader, mode, name, dtype)
        return [found[name] for name in names]

    def by_index(self, mode: str, name: str, *, loads: bool) -> MemoryColumn | MappedColumn:
        """Return a field to gather rows from: in memory, or mapped.

        Args:
            mode: Name of the mode.
            name: Name of the field.
            loads: Whether to read it into memory if it fits there.
        """
        missing = self.missing(mode, name, None)
        if self.reader.field(mode, name).nbytes and (
            not missing or (loads and missing <= memory.memory_budget())
        ):
            return self.load(mode, name)
        found = self.map(mode, name)
        found.check()
        return found

    def load(self, mode: str, name: str, dtype: np.dtype[Any] | None = None) -> MemoryColumn:
        """Load all currently committed rows of a field into memory and return them."""
        self._drop_stale()
        field = self.reader.field(mode, name)
        key = mode, name, field.converted_dtype(dtype)
        column = self._loaded.get(key)
        if column is None:
            column = self._loaded[key] = MemoryColumn(self.reader, mode, field, key[2])
        rows = self.reader.stored_values(mode, name)
        if column.shape[0] != rows:
            self.reader.check(mode, name, column.shape[0])
            column.extend(rows)
        return column

    def map(self, mode: str, name: str) -> MappedColumn:
        """Map all currently committed rows of a field into the address space and return them."""
        self._drop_stale()
        field, rows = self.reader.field(mode, name), self.reader.stored_values(mode, name)
        column = self._mapped.get((mode, name))
        if column is None or column.shape[0] != rows:
            column = MappedColumn(self.reader.segments(mode, name), field)
            self._mapped[mode, name] = column
        return column

    def take(self, mode: str, name: str, index: Index) -> Array:
        """Return stored rows of a field as a new array, shape (n, *field shape)."""
        column, field = self.map(mode, name), self.reader.field(mode, name)
        column.check()
        if field.free_axis:
            bounds = self.reader.bounds(mode, field.free_axis)
            starts, counts = bounds[index], bounds[index + 1] - bounds[index]
            entries = np.empty((int(counts.sum()), *field.entry_shape), column.dtype)
            if entries.size:
                column.copy(starts, counts, entries)
            return split(entries, counts)
        out = np.empty((len(index), *column.shape[1:]), column.dtype)
        column.gather(index, out)
        return out

    def missing(self, mode: str, name: str, dtype: np.dtype[Any] | None) -> int:
        """Return the number of bytes of memory that loading a field would take."""
        self._drop_stale()
        field = self.reader.field(mode, name)
        kind = field.converted_dtype(dtype)
        loaded = self._loaded.get((mode, name, kind))
        rows = self.reader.stored_values(mode, name) - (loaded.shape[0] if loaded else 0)
        return rows * (field.nbytes // np.dtype(field.dtype).itemsize) * kind.itemsize

    def clear(self) -> None:
        """Free memory and address space."""
        self._loaded.clear()
        self._mapped.clear()

    def _drop_stale(self) -> None:
        if self._generation != self.reader.manifest.generation:
            self._generation = self.reader.manifest.generation
            self.clear()
