"""Caches columns of a dataset that are in memory or mapped."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.strategies.mapping import MappedColumn
from physx_core.dataset.read.strategies.strategy import Strategy, choose_strategy
from physx_core.fields import Field
from physx_core.typing import Array, Index


class MemoryColumn:
    """The stored rows of a field in memory, in the requested type.

    Attributes:
        shape: (rows, *field shape).
    """

    def __init__(self, reader: Reader, mode: str, field: Field, dtype: np.dtype[Any]) -> None:
        self.shape: tuple[int, ...] = (0, *(field.shape or ()))
        self._reader = reader
        self._mode, self._name = mode, field.name
        self._plain = np.dtype(field.dtype) == dtype
        self._array = np.empty(self.shape, dtype)

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
        self.shape = (rows, *self.shape[1:])

    @property
    def array(self) -> Array:
        """The rows, of shape `shape`."""
        return self._array[: self.shape[0]]

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

    def choose_strategy(
        self, mode: str, names: Sequence[str], dtype: np.dtype[Any] | None = None
    ) -> Strategy:
        """Return the best strategy to read the rows of fields now.

        Args:
            mode: Name of the mode.
            names: Names of the fields.
            dtype: Type that floating-point fields are converted to; None: no conversion.
        """
        fields = [self.reader.field(mode, name) for name in names]
        return choose_strategy(sum(self.missing(mode, name, dtype) for name in names), fields)

    def load(self, mode: str, name: str, dtype: np.dtype[Any] | None = None) -> MemoryColumn:
        """Load all currently committed rows of a field into memory and return them."""
        self._drop_stale()
        field = self.reader.field(mode, name)
        key = mode, name, converted_dtype(field, dtype)
        column = self._loaded.get(key)
        if column is None:
            column = self._loaded[key] = MemoryColumn(self.reader, mode, field, key[2])
        rows = self.reader.stored_rows(mode)
        if column.shape[0] != rows:
            self.reader.check(mode, name, column.shape[0])
            column.extend(rows)
        return column

    def map(self, mode: str, name: str) -> MappedColumn:
        """Map all currently committed rows of a field into the address space and return them."""
        self._drop_stale()
        field, rows = self.reader.field(mode, name), self.reader.stored_rows(mode)
        column = self._mapped.get((mode, name))
        if column is None or column.shape[0] != rows:
            column = MappedColumn(self.reader.segments(mode, name), field)
            self._mapped[mode, name] = column
        return column

    def missing(self, mode: str, name: str, dtype: np.dtype[Any] | None) -> int:
        """Return the number of bytes of memory that loading a field would take."""
        self._drop_stale()
        field = self.reader.field(mode, name)
        kind = converted_dtype(field, dtype)
        loaded = self._loaded.get((mode, name, kind))
        rows = self.reader.stored_rows(mode) - (loaded.shape[0] if loaded else 0)
        return rows * (field.nbytes // np.dtype(field.dtype).itemsize) * kind.itemsize

    def clear(self) -> None:
        """Free memory and address space."""
        self._loaded.clear()
        self._mapped.clear()

    def _drop_stale(self) -> None:
        if self._generation != self.reader.manifest.generation:
            self._generation = self.reader.manifest.generation
            self.clear()


def converted_dtype(field: Field, dtype: np.dtype[Any] | None) -> np.dtype[Any]:
    """Return the type of a field's rows if floating-point fields are converted to `dtype`."""
    own = np.dtype(field.dtype)
    return own if dtype is None or own.kind != "f" else dtype
