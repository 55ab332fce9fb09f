"""Views: a mode's fields and a field's rows, read when they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from physx_core.dataset.read.cache import ColumnCache
from physx_core.dataset.read.reader import Reader
from physx_core.fields import Field
from physx_core.typing import Array


class FieldView:
    """The rows of one field: takes a row's number, a slice, or an array of numbers or booleans.

    Whatever is returned is a copy.
    """

    def __init__(self, reader: Reader, columns: ColumnCache, mode: str, field: Field) -> None:
        self.field = field
        self._reader = reader
        self._columns = columns
        self._mode = mode

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, *field shape)."""
        return (len(self), *(self.field.shape or ()))

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values."""
        return np.dtype(self.field.dtype)

    def __len__(self) -> int:
        return self._reader.rows(self._mode)

    def __getitem__(self, rows: Any) -> Any:
        if isinstance(rows, (int, np.integer)) and not isinstance(rows, bool):
            row = int(rows) + (len(self) if rows < 0 else 0)
            if not 0 <= row < len(self):
                raise IndexError(f"Row {rows} is out of range: there are {len(self)} rows.")
            return self._read(row, row + 1)[0]
        if isinstance(rows, slice):
            start, stop, step = rows.indices(len(self))
            if step == 1:
                return self._read(start, max(start, stop))
            return self._gather(np.arange(start, stop, step))
        if isinstance(rows, (list, np.ndarray)):
            return self._gather(self._index(np.asarray(rows)))
        raise IndexError(
            f"Rows are taken by a number, a slice or an array of numbers, not by {rows!r}. "
            "For a part of each row, index the result."
        )

    def __iter__(self) -> Iterator[Any]:
        for block in self._reader.blocks(self._mode, self.field.name):
            yield from block.copy()

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> Array:
        if copy is False:
            raise ValueError("The rows lie on the disk: reading them makes a copy.")
        rows = self._read(0, len(self))
        return rows if dtype is None else rows.astype(dtype, copy=False)

    def __repr__(self) -> str:
        unit = f" in {self.field.unit}" if self.field.unit else ""
        return f"<{self._mode}/{self.field.name}: {self.shape} {self.dtype}{unit}>"

    def _read(self, start: int, stop: int) -> Array:
        return self._reader.read(self._mode, self.field.name, start, stop)

    def _gather(self, index: Array) -> Array:
        column = self._columns.map(self._mode, self.field.name)
        column.check()
        out = np.empty((len(index), *column.shape[1:]), column.dtype)
        column.gather(index.astype(np.intp, copy=False), out)
        return out

    def _index(self, rows: Array) -> Array:
        """Return row numbers in range, from numbers that may be negative or from booleans."""
        total = len(self)
        if rows.dtype.kind == "b" and rows.shape == (total,):
            return np.flatnonzero(rows)
        if not rows.size:
            return np.zeros(0, np.intp)
        if rows.dtype.kind not in "iu" or rows.ndim != 1:
            raise IndexError(
                f"An index array has whole numbers and one axis, or {total} booleans; this one "
                f"has type {rows.dtype} and shape {rows.shape}."
            )
        if rows.min() < -total or rows.max() >= total:
            raise IndexError(f"Row numbers are out of range: there are {total} rows.")
        return np.where(rows < 0, rows + total, rows)


class ModeView:
    """The fields of one mode by name; iterating gives the names."""

    def __init__(self, reader: Reader, columns: ColumnCache, mode: str) -> None:
        self._reader = reader
        self._columns = columns
        self._mode = mode

    def __getitem__(self, name: str) -> FieldView:
        field = self._reader.field(self._mode, name)
        return FieldView(self._reader, self._columns, self._mode, field)

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __len__(self) -> int:
        return len(self.keys())

    def __contains__(self, name: object) -> bool:
        return name in self.keys()

    def keys(self) -> list[str]:
        """Return the names of the fields."""
        return list(self._reader.mode(self._mode).fields)

    def items(self) -> list[tuple[str, FieldView]]:
        """Return names and fields."""
        return [(name, self[name]) for name in self.keys()]

    def __repr__(self) -> str:
        return f"<{self._mode}: {self._reader.rows(self._mode)} samples of {self.keys()}>"
