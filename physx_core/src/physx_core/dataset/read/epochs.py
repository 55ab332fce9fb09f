"""Epochs: passes over rows in a given order, from memory or from the disk at different speeds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from physx_core.dataset.read.access.columns import ColumnCache, MemoryColumn
from physx_core.dataset.read.access.disk import DiskColumn
from physx_core.dataset.read.shuffling import (
    LARGE_ROW,
    BlockOrder,
    Chunk,
    ExactOrder,
    ItemOrder,
    StoredOrder,
)
from physx_core.processes import Helper
from physx_core.typing import Array, Batch, Index

_AHEAD = 2**24  # bytes that the system is asked to read ahead

Stored: TypeAlias = Callable[[Index], Index] | None
"""Returns the stored rows of some items; None: they are the same."""


class Epoch(Protocol):
    """One pass over all items; raises a `DatasetError` if a partition cannot be read."""

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next items of each field into the arrays of a batch.

        Args:
            start: Position of the first one.
            batch: The fields in the requested order, with arrays of equal length.
        """

    def close(self) -> None:
        """Close open files."""


def begin_epoch(
    cache: ColumnCache,
    mode: str,
    names: Sequence[str],
    dtype: np.dtype[Any] | None,
    order: ItemOrder,
    stored: Stored,
) -> Epoch:
    """Return a pass over items of a mode, read in the fastest way that the free memory allows.

    Args:
        cache: The columns.
        mode: Name of the mode.
        names: Names of the fields.
        dtype: Type that floating-point fields are converted to; None: no conversion.
        order: The order.
        stored: Returns the stored rows of some items.
    """
    columns = cache.open(mode, names, dtype, loads=not isinstance(order, BlockOrder))
    loaded = [column for column in columns if isinstance(column, MemoryColumn)]
    if len(loaded) == len(columns):
        if isinstance(order, ExactOrder) and order.is_sorted:
            return MemoryEpoch(loaded, order.all if stored is None else stored(order.all))
        if isinstance(order, StoredOrder) and stored is None:
            return MemoryEpoch(loaded, None)
    nbytes = sum(column.row_nbytes for column in columns if isinstance(column, DiskColumn))
    if nbytes < LARGE_ROW or isinstance(order, BlockOrder):
        return ChunkedEpoch(columns, order, stored)
    return RowEpoch(columns, order, stored, max(1, _AHEAD // nbytes))


class MemoryEpoch:
    """A pass over rows in memory."""

    def __init__(self, columns: Sequence[MemoryColumn], rows: Index | None) -> None:
        """Begin a pass.

        Args:
            columns: The fields.
            rows: The stored row at each position; None: the first rows.
        """
        self._arrays = [column.array for column in columns]
        self._takes = [array.take for array in self._arrays]
        self._rows = rows

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows: see `Epoch`."""
        outs = list(batch.values())
        stop = start + len(outs[0])
        if self._rows is None:
            for array, out in zip(self._arrays, outs):  # noqa: B905 (the hot path)
                out[...] = array[start:stop]
        else:
            index = self._rows[start:stop]
            for take, out in zip(self._takes, outs):  # noqa: B905
                take(index, 0, out, "clip")  # all modes but the default write directly to `out`

    def close(self) -> None:
        """Do nothing: the columns are kept for the next epoch."""


class RowEpoch:
    """A pass over large rows on disk, each read to where it is needed; the system reads ahead."""

    def __init__(
        self,
        columns: Sequence[MemoryColumn | DiskColumn],
        order: ItemOrder,
        stored: Stored,
        ahead: int,
    ) -> None:
        """Begin a pass.

        Args:
            columns: The fields; some may be in memory.
            order: The order.
            stored: Returns the stored rows of some items.
            ahead: How many rows are announced to the system before they are read.
        """
        self._columns, self._order, self._stored, self._ahead = columns, order, stored, ahead
        self._disk = [column for column in columns if isinstance(column, DiskColumn)]
        self._announced = 0

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows: see `Epoch`."""
        outs = list(batch.values())
        stop = start + len(outs[0])
        for first in range(start, stop, self._ahead):
            last = min(first + self._ahead, stop)
            self._announce(last, min(last + self._ahead, self._order.count))
            index = self._rows(first, last)
            for column, out in zip(self._columns, outs, strict=True):
                column.gather(index, out[first - start : last - start])

    def close(self) -> None:
        """Close the files."""
        for column in self._disk:
            column.close()

    def _announce(self, start: int, stop: int) -> None:
        """Announce the rows at some positions, unless they were."""
        start = max(start, self._announced)
        if start < stop:
            self._announced, rows = stop, self._rows(start, stop)
            pieces = self._disk[0].locate(rows)
            for column in self._disk:
                column.announce(pieces)

    def _rows(self, start: int, stop: int) -> Index:
        items = self._order.items(start, stop)
        return items if self._stored is None else self._stored(items)


class _Loaded(NamedTuple):
    """A chunk with its rows, by field."""

    chunk: Chunk
    rows: list[Array]


class ChunkedEpoch:
    """A pass over rows on disk, read chunk by chunk; a thread reads the next one."""

    def __init__(
        self, columns: Sequence[MemoryColumn | DiskColumn], order: ItemOrder, stored: Stored
    ) -> None:
        """Begin a pass.

        Args:
            columns: The fields; some may be in memory.
            order: The order.
            stored: Returns the stored rows of some items.
        """
        self._columns, self._order, self._stored = columns, order, stored
        self._disk = [column for column in columns if isinstance(column, DiskColumn)]
        self._current = _Loaded(Chunk(0, 0, np.zeros(0, np.intp), None), self._allocate(0))
        self._spare = self._allocate(0)
        self._helper = Helper[_Loaded]("physx-read")

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows: see `Epoch`."""
        outs = list(batch.values())
        done, count = 0, len(outs[0])
        while done < count:
            chunk, several = self._current
            if not chunk.start <= start + done < chunk.stop:
                self._go_to(start + done)
                continue
            first = start + done - chunk.start
            part = min(count - done, chunk.stop - chunk.start - first)
            for rows, out in zip(several, outs, strict=True):
                target = out[done : done + part]
                if chunk.places is None:
                    target[...] = rows[first : first + part]
                else:
                    rows.take(chunk.places[first : first + part], 0, target, "clip")
            done += part

    def close(self) -> None:
        """Close the files."""
        self._helper.close()
        for column in self._disk:
            column.close()

    def _go_to(self, position: int) -> None:
        """Take the chunk with a position, and have the one after it read."""
        former, spare = self._current.rows, self._spare
        loaded = self._helper.take() if self._helper.pending else None
        if loaded is None or not loaded.chunk.start <= position < loaded.chunk.stop:
            loaded = self._load(position, spare if loaded is None else loaded.rows)
        self._current, self._spare = loaded, former
        if loaded.chunk.stop < self._order.count:
            following = loaded.chunk.stop
            self._helper.give(lambda: self._load(following, former))

    def _load(self, position: int, arrays: list[Array]) -> _Loaded:
        """Read the chunk with a position, into these arrays if they are large enough."""
        chunk = self._order.chunk(position)
        rows = chunk.items if self._stored is None else self._stored(chunk.items)
        pieces = self._disk[0].locate(rows) if self._disk else []
        for on_disk in self._disk:
            on_disk.announce(pieces)
        if len(arrays[0]) < len(rows):
            arrays = self._allocate(len(rows))
        for column, out in zip(self._columns, arrays, strict=True):
            if isinstance(column, DiskColumn):
                column.gather(rows, out[: len(rows)], pieces)
            else:
                column.gather(rows, out[: len(rows)])
        return _Loaded(chunk, arrays)

    def _allocate(self, count: int) -> list[Array]:
        return [np.empty((count, *column.shape[1:]), column.dtype) for column in self._columns]
