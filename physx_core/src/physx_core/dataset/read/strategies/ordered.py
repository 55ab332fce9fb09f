"""Reads rows in the order of a mode, which may differ from the order in which they are stored."""

from __future__ import annotations

import numpy as np

from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.strategies.disk import DiskColumn
from physx_core.typing import Array, Index


def ordered_rows(reader: Reader, mode: str, subset: Index | None) -> Index | None:
    """Return the stored rows of a mode or of some of its rows; None for the first stored rows."""
    index = reader.index(mode)
    if index is None or subset is None:
        return subset if index is None else index
    return index[subset]


def shuffled_rows(
    reader: Reader, mode: str, subset: Index | None, random: np.random.Generator
) -> Index:
    """Return the stored rows of a mode or of some of its rows, in random order."""
    index = reader.index(mode)
    rows = random.permutation(reader.rows(mode) if subset is None else subset)
    return rows if index is None else index[rows]


class OrderedColumn:
    """A field on disk by row of the mode; close it after use.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the returned rows.
        row_nbytes: Bytes of one stored row.
    """

    def __init__(self, stored: DiskColumn, order: Order) -> None:
        self.shape = (order.rows, *stored.shape[1:])
        self.dtype, self.row_nbytes = stored.dtype, stored.row_nbytes
        self._stored, self._order = stored, order

    def announce(self, start: int, count: int = 1) -> None:
        """Tell the operating system that `count` rows from `start` on will be read soon."""
        for first, rows in self._order.pieces(start, start + count):
            self._stored.announce(first, rows)

    def slice(self, start: int, out: Array) -> None:
        """Copy consecutive rows into a contiguous array, shape (rows, *field shape)."""
        done = 0
        for first, rows in self._order.pieces(start, start + len(out)):
            self._stored.slice(first, out[done : done + rows])
            done += rows

    def close(self) -> None:
        """Close the files; reading opens them again."""
        self._stored.close()


def in_order(reader: Reader, mode: str, stored: DiskColumn) -> DiskColumn | OrderedColumn:
    """Return a field on disk by row of the mode."""
    order = reader.order(mode)
    return stored if order is None else OrderedColumn(stored, order)
