"""Shuffles rows on disk exactly while the system prefetches upcoming rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.dataset.read.strategies.cache import ColumnCache, MemoryColumn
from physx_core.dataset.read.strategies.disk import DiskColumn
from physx_core.dataset.read.strategies.ordered import shuffled_rows
from physx_core.dataset.read.strategies.strategy import LARGE_ROW, memory_budget
from physx_core.typing import Batch, Index

_AHEAD = 2**24  # bytes that the system is asked to read ahead


class ExactEpoch:
    """A pass over rows on disk, in the same permutation as in memory.

    Fields with small rows are read into memory if they fit there together.

    Attributes:
        rows: Number of rows.
    """

    def __init__(
        self,
        columns: ColumnCache,
        mode: str,
        names: Sequence[str],
        dtype: np.dtype[Any] | None,
        random: np.random.Generator,
        subset: Index | None = None,
    ) -> None:
        """Draw the permutation and open the columns.

        Args:
            columns: Columns in memory, and the reader for the others.
            mode: Name of the mode.
            names: Names of the fields.
            dtype: Type that floating-point fields are converted to; None: no conversion.
            random: Draws the permutation.
            subset: Numbers of the rows to read; None: all.
        """
        self._order = shuffled_rows(columns.reader, mode, subset, random)
        self.rows = len(self._order)
        small = _small(columns, mode, names, dtype)
        self._columns: list[MemoryColumn | DiskColumn] = [
            columns.load(mode, name, dtype)
            if name in small
            else DiskColumn(columns.reader, mode, name, dtype)
            for name in names
        ]
        self._disk = [column for column in self._columns if isinstance(column, DiskColumn)]
        row_nbytes = sum(column.row_nbytes for column in self._disk)
        self._ahead = max(1, _AHEAD // max(1, row_nbytes))
        self._announced = 0

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows: see `Epoch`."""
        outs = list(batch.values())
        stop = start + len(outs[0])
        for first in range(start, stop, self._ahead):
            last = min(first + self._ahead, stop)
            self._announce(last + self._ahead)
            index = self._order[first:last]
            for column, out in zip(self._columns, outs, strict=True):
                column.gather(index, out[first - start : last - start])

    def close(self) -> None:
        """Close the files."""
        for column in self._disk:
            column.close()

    def _announce(self, stop: int) -> None:
        """Announce the permutation's rows up to `stop` to the operating system."""
        for row in self._order[self._announced : stop].tolist():
            for column in self._disk:
                column.announce(row)
        self._announced = max(self._announced, min(stop, self.rows))


def _small(
    columns: ColumnCache, mode: str, names: Sequence[str], dtype: np.dtype[Any] | None
) -> set[str]:
    """Return the fields with small rows that fit into memory together, smallest fields first."""
    left, found = memory_budget(), set()
    for size, name in sorted((columns.missing(mode, name, dtype), name) for name in names):
        if size <= left and columns.reader.field(mode, name).nbytes < LARGE_ROW:
            left -= size
            found.add(name)
    return found
