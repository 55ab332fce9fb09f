"""Views of a mode's fields and of a field's rows, which are read on access."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.fields import Field
from physx_core.typing import Array, Index

_FREE_ROWS = 256


class FieldView:
    """The rows of one field, indexed by a number, a slice, or an array of numbers or booleans.

    Every result is a copy. Rows of a field with a free axis are an array of objects, one array for
    each row.

    Attributes:
        field: The field.
    """

    def __init__(self, columns: ColumnCache, mode: str, field: Field) -> None:
        self.field = field
        self._columns = columns
        self._reader = columns.reader
        self._mode = mode

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, *field shape); with a free axis, (rows,)."""
        return (len(self), *self.field.row_kind[0])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the rows: of their values, or with a free axis `object`, as each is an array."""
        return self.field.row_kind[1]

    def __len__(self) -> int:
        return self._reader.rows(self._mode)

    def __getitem__(self, rows: Any) -> Array:
        if isinstance(rows, np.ndarray) and not rows.ndim:
            rows = rows[()]
        if isinstance(rows, (int, np.integer)) and not isinstance(rows, bool):
            row = int(rows) + (len(self) if rows < 0 else 0)
            if not 0 <= row < len(self):
                raise IndexError(f"Row {rows} is out of range: there are {len(self)} rows.")
            single: Array = self._read(row, row + 1)[0]
            return single
        if isinstance(rows, slice):
            start, stop, step = rows.indices(len(self))
            if step == 1:
                return self._read(start, max(start, stop))
        if isinstance(rows, (slice, list, np.ndarray)):
            return self._gather(row_numbers(rows, len(self)))
        raise IndexError(
            f"Rows are selected by a number, a slice or an array of numbers, not by {rows!r}. "
            "For a part of each row, index the result."
        )

    def __iter__(self) -> Iterator[Any]:
        if self._reader.order(self._mode) is None and not self.field.free_axis:
            for block in self._reader.blocks(self._mode, self.field.name):
                yield from block.copy()
            return
        stored, total = self._reader.index(self._mode), len(self)
        step = rows_per_block(self.field.nbytes) if not self.field.free_axis else _FREE_ROWS
        for start in range(0, total, step):
            rows = np.arange(start, min(start + step, total))
            yield from self._take(rows if stored is None else stored[rows])

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> Array:
        if copy is False:
            raise ValueError("The rows are on disk: reading them makes a copy.")
        rows = self._read(0, len(self))
        return rows if dtype is None else rows.astype(dtype, copy=False)

    def __repr__(self) -> str:
        unit = f" in {self.field.unit}" if self.field.unit else ""
        return f"<{self._mode}/{self.field.name}: {self.shape} {self.dtype}{unit}>"

    def _read(self, start: int, stop: int) -> Array:
        order = self._reader.order(self._mode)
        if order is not None:
            pieces = list(itertools.islice(order.pieces(start, stop), 2))
            if len(pieces) > 1:
                return self._gather(np.arange(start, stop))
            start, stop = (pieces[0][0], sum(pieces[0])) if pieces else (0, 0)
        return self._reader.read(self._mode, self.field.name, start, stop)

    def _gather(self, rows: Index) -> Array:
        stored = self._reader.index(self._mode)
        return self._take(rows if stored is None else stored[rows])

    def _take(self, index: Index) -> Array:
        """Return stored rows."""
        return self._columns.take(self._mode, self.field.name, index)


class ModeView:
    """The fields of one mode by name; iterating gives the names.

    Attributes:
        columns: Caches the columns.
        mode: Name of the mode.
    """

    def __init__(self, columns: ColumnCache, mode: str) -> None:
        self.columns = columns
        self.mode = mode

    def __getitem__(self, name: str) -> FieldView:
        field = self.columns.reader.field(self.mode, name)
        return FieldView(self.columns, self.mode, field)

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __len__(self) -> int:
        return len(self.keys())

    def __contains__(self, name: object) -> bool:
        return name in self.keys()

    def keys(self) -> list[str]:
        """Return the names of the fields."""
        return list(self.columns.reader.mode(self.mode).fields)

    def items(self) -> list[tuple[str, FieldView]]:
        """Return names and fields."""
        return [(name, self[name]) for name in self.keys()]

    @property
    def rows(self) -> ModeRows:
        """The rows as they are now."""
        return ModeRows(self.columns, self.mode)

    def __repr__(self) -> str:
        return f"<{self.mode}: {self.columns.reader.rows(self.mode)} samples of {self.keys()}>"


def row_numbers(index: Any, total: int) -> Index:
    """Return the numbers of the rows that a number, a slice or an array selects.

    Args:
        index: A number, which may be negative, a slice, or an array of numbers or `total` booleans.
        total: Number of rows of the mode.

    Raises:
        IndexError: If there are no such rows, or the index is of another kind.
    """
    if isinstance(index, slice):
        return np.arange(*index.indices(total))
    numbers = np.atleast_1d(np.asarray(index))
    if numbers.dtype.kind == "b" and numbers.shape == (total,):
        return np.flatnonzero(numbers)
    if not numbers.size:
        return np.zeros(0, np.intp)
    if numbers.dtype.kind not in "iu" or numbers.ndim != 1:
        raise IndexError(
            f"An index array must hold integers along one axis, or {total} booleans; this one "
            f"has type {numbers.dtype} and shape {numbers.shape}."
        )
    if numbers.min() < -total or numbers.max() >= total:
        raise IndexError(f"Row numbers are out of range: there are {total} rows.")
    numbers = numbers.astype(np.intp, copy=False)  # the sum would overflow in a small type
    return np.where(numbers < 0, numbers + total, numbers)
