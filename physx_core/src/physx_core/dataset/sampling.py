"""Batches: gathering rows at random into reused buffers.

Fields that together fit well into memory are read into it once; rows of larger ones are gathered
from memory-mapped partitions. In both cases an epoch is an exact permutation of all rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.reader import Reader
from physx_core.errors import ConfigError, DatasetError
from physx_core.fields import Array, Batch, Field

Index = NDArray[np.intp]
_SHARE = 0.25
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


class Column(Protocol):
    """All rows of one field.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the rows that are given.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    def gather(self, index: Index, out: Array) -> None:
        """Copy the rows of an index array, all in range, into `out`."""

    def slice(self, start: int, stop: int, out: Array) -> None:
        """Copy consecutive rows into `out`."""


class MemoryColumn:
    """A field in memory, in the type it is asked for."""

    def __init__(self, reader: Reader, mode: str, field: Field, dtype: np.dtype[Any]) -> None:
        self.shape: tuple[int, ...] = (0, *(field.shape or ()))
        self.dtype = dtype
        self._reader = reader
        self._mode, self._name = mode, field.name
        self._plain = np.dtype(field.dtype) == dtype
        self._array = np.empty(self.shape, dtype)

    def extend(self, rows: int) -> None:
        """Read what is not there yet of the first `rows` rows."""
        have = self.shape[0]
        if rows > len(self._array):
            grown = np.empty((max(rows, 2 * have), *self.shape[1:]), self.dtype)
            grown[:have] = self._array[:have]
            self._array = grown
        if self._plain:
            self._reader.read_into(self._array[have:rows], self._mode, self._name, have)
        else:
            for block in self._reader.blocks(self._mode, self._name, have):
                end = min(rows, have + len(block))
                self._array[have:end] = block[: end - have]
                have = end
        self.shape = (rows, *self.shape[1:])

    def gather(self, index: Index, out: Array) -> None:
        """Copy the rows of an index array, all in range, into `out`."""
        # Any mode but the default one writes straight into `out`.
        self._array.take(index, 0, out, "clip")

    def slice(self, start: int, stop: int, out: Array) -> None:
        """Copy consecutive rows into `out`."""
        out[...] = self._array[start:stop]


class MappedColumn:
    """A field on the disk, mapped partition by partition."""

    def __init__(self, reader: Reader, mode: str, field: Field, dtype: np.dtype[Any]) -> None:
        self.shape: tuple[int, ...] = (reader.rows(mode), *(field.shape or ()))
        self.dtype = dtype
        segments = reader.segments(mode, field.name)
        self._parts = [segment.map(field) for segment in segments]
        self._starts = np.array([*(segment.start for segment in segments), self.shape[0]])

    def gather(self, index: Index, out: Array) -> None:
        """Copy the rows of an index array, all in range, into `out`."""
        owner = np.searchsorted(self._starts, index, side="right") - 1
        for number in np.unique(owner):
            here = np.flatnonzero(owner == number)
            out[here] = self._parts[number][index[here] - self._starts[number]]

    def slice(self, start: int, stop: int, out: Array) -> None:
        """Copy consecutive rows into `out`."""
        self.gather(np.arange(start, stop), out)


class ColumnCache:
    """The columns of a dataset, kept from one use to the next."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._kept: dict[tuple[str, str, np.dtype[Any]], MemoryColumn | MappedColumn] = {}

    def get(
        self,
        mode: str,
        names: Sequence[str],
        dtype: np.dtype[Any] | None = None,
        *,
        load: bool = True,
    ) -> list[Column]:
        """Return columns of all rows that are committed now.

        Args:
            mode: Name of the mode.
            names: Names of the fields.
            dtype: Type that floating fields are converted to; None: each keeps its own.
            load: Whether to read them into memory, if they fit.

        Raises:
            DatasetError: A field does not exist, or a partition is missing or damaged.
        """
        fields = [self._reader.field(mode, name) for name in names]
        kinds = [_wanted(field, dtype) for field in fields]
        rows, missing = self._reader.rows(mode), 0
        for field, kind in zip(fields, kinds, strict=True):
            kept = self._kept.get((mode, field.name, kind))
            have = kept.shape[0] if isinstance(kept, MemoryColumn) else 0
            missing += (rows - have) * (field.nbytes // _item(field)) * kind.itemsize
        load = load and (not missing or missing <= _SHARE * available_memory())
        return [
            self._column(mode, field, kind, rows, load)
            for field, kind in zip(fields, kinds, strict=True)
        ]

    def rows(self, mode: str, names: Sequence[str]) -> int:
        """Return the number of committed rows of fields.

        Raises:
            DatasetError: There is no such mode or field.
        """
        for name in names:
            self._reader.field(mode, name)
        return self._reader.rows(mode)

    def clear(self) -> None:
        """Free the memory."""
        self._kept.clear()

    def _column(
        self, mode: str, field: Field, kind: np.dtype[Any], rows: int, load: bool
    ) -> Column:
        key = mode, field.name, kind
        kept = self._kept.get(key)
        loaded = isinstance(kept, MemoryColumn)
        if kept is not None and kept.shape[0] == rows and (loaded or not load):
            return kept
        if load:
            column = kept if isinstance(kept, MemoryColumn) else None
            column = column or MemoryColumn(self._reader, mode, field, kind)
            column.extend(rows)
            self._kept[key] = column
            return column
        mapped = self._kept[key] = MappedColumn(self._reader, mode, field, kind)
        return mapped


@dataclass(frozen=True)
class Batches:
    """One request for batches, see `Dataset.batches`; iterating makes them.

    Attributes:
        columns: Where the rows come from.
        mode: Name of the mode.
        names: Names of the fields.
        batch_size: Rows of a batch.
        epochs: How often to go through all rows; None: without end.
        random: Draws a permutation for each epoch; None: the order of the rows.
        dtype: Type that floating fields are converted to; None: each keeps its own.
        reuse: Whether every batch is given in the same arrays.
    """

    columns: ColumnCache
    mode: str
    names: Sequence[str]
    batch_size: int
    epochs: int | None
    random: np.random.Generator | None
    dtype: np.dtype[Any] | None
    reuse: bool

    def __post_init__(self) -> None:
        """Check that there is something to give.

        Raises:
            ConfigError: `batch_size` or `epochs` is out of range, or no field is asked for.
            DatasetError: A field does not exist, or there are no samples.
        """
        if self.batch_size < 1:
            raise ConfigError(f"batch_size is {self.batch_size} but must be at least 1.")
        if self.epochs is not None and self.epochs < 0:
            raise ConfigError(f"epochs is {self.epochs} but cannot be negative.")
        if not self.names:
            raise ConfigError("Batches need at least one field.")
        if not self.columns.rows(self.mode, self.names):
            raise DatasetError(
                f'Mode "{self.mode}" has no samples yet, so there are no batches to read.'
            )

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of all epochs."""
        epoch, buffers = 0, None
        while self.epochs is None or epoch < self.epochs:
            columns = self.columns.get(self.mode, self.names, self.dtype)
            if buffers is None and self.reuse:
                buffers = [np.empty((self.batch_size, *c.shape[1:]), c.dtype) for c in columns]
            yield from self._epoch(columns, buffers)
            epoch += 1

    def _epoch(self, columns: list[Column], buffers: list[Array] | None) -> Iterator[Batch]:
        rows, size = columns[0].shape[0], self.batch_size
        order = self.random.permutation(rows) if self.random is not None else None
        for start in range(0, rows, size):
            stop = min(start + size, rows)
            batch = {}
            for number, column in enumerate(columns):
                if buffers is None:
                    out = np.empty((stop - start, *column.shape[1:]), column.dtype)
                else:
                    out = (
                        buffers[number] if stop - start == size else buffers[number][: rows - start]
                    )
                if order is None:
                    column.slice(start, stop, out)
                else:
                    column.gather(order[start:stop], out)
                batch[self.names[number]] = out
            yield batch


def available_memory() -> int:
    """Return how many bytes of memory processes here may still take."""
    text = Path("/proc/meminfo").read_text(encoding="ascii")
    lines = dict(line.split(":", 1) for line in text.splitlines())
    available = int(lines["MemAvailable"].split()[0]) * 1024
    for name in _LIMITS:
        path = Path(name)
        if path.is_file() and (limit := path.read_text(encoding="ascii").strip()).isdigit():
            available = min(available, int(limit))
    return available


def _wanted(field: Field, dtype: np.dtype[Any] | None) -> np.dtype[Any]:
    own = np.dtype(field.dtype)
    return own if dtype is None or own.kind != "f" else dtype


def _item(field: Field) -> int:
    return np.dtype(field.dtype).itemsize
