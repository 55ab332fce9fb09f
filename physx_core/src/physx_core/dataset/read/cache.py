"""The columns of a dataset that are in memory or mapped, kept from one use to the next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.read import strategy
from physx_core.dataset.read.mapping import MappedColumn
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.strategy import Strategy
from physx_core.fields import Field
from physx_core.typing import Array

Index: TypeAlias = NDArray[np.intp]


class MemoryColumn:
    """A field in memory, in the type it is asked for.

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
        """Read what is not there yet of the first `rows` rows.

        Raises:
            DatasetError: A partition is missing, truncated or damaged.
        """
        have = self.shape[0]
        if rows > len(self._array):
            grown = np.empty((max(rows, 2 * have), *self.shape[1:]), self._array.dtype)
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

    @property
    def array(self) -> Array:
        """The rows, of shape `shape`."""
        return self._array[: self.shape[0]]

    def gather(self, index: Index, out: Array) -> None:
        """Copy the rows of an index array, all in range, into `out`."""
        # Any mode but the default one writes straight into `out`.
        self._array.take(index, 0, out, "clip")


class ColumnCache:
    """The columns of a dataset, kept from one use to the next."""

    def __init__(self, reader: Reader) -> None:
        self.reader = reader
        self._loaded: dict[tuple[str, str, np.dtype[Any]], MemoryColumn] = {}
        self._mapped: dict[tuple[str, str], MappedColumn] = {}

    def strategy(self, mode: str, names: Sequence[str], dtype: np.dtype[Any] | None) -> Strategy:
        """Return how the rows of fields are best read now.

        Args:
            mode: Name of the mode.
            names: Names of the fields.
            dtype: Type that floating fields are converted to; None: each keeps its own.

        Raises:
            DatasetError: There is no such mode or field.
        """
        fields = [self.reader.field(mode, name) for name in names]
        return strategy.choose(sum(self.missing(mode, name, dtype) for name in names), fields)

    def load(self, mode: str, name: str, dtype: np.dtype[Any] | None = None) -> MemoryColumn:
        """Return all rows of a field that are committed now, in memory.

        Raises:
            DatasetError: The field does not exist, or a partition is missing or damaged.
        """
        field = self.reader.field(mode, name)
        key = mode, name, wanted(field, dtype)
        column = self._loaded.get(key)
        if column is None:
            column = self._loaded[key] = MemoryColumn(self.reader, mode, field, key[2])
        rows = self.reader.rows(mode)
        if column.shape[0] != rows:
            self.reader.check(mode, name, column.shape[0])
            column.extend(rows)
        return column

    def map(self, mode: str, name: str) -> MappedColumn:
        """Return all rows of a field that are committed now, mapped into the address space.

        Raises:
            DatasetError: The field does not exist, or a partition is missing or damaged.
        """
        field, rows = self.reader.field(mode, name), self.reader.rows(mode)
        column = self._mapped.get((mode, name))
        if column is None or column.shape[0] != rows:
            column = MappedColumn(self.reader.segments(mode, name), field)
            self._mapped[mode, name] = column
        return column

    def missing(self, mode: str, name: str, dtype: np.dtype[Any] | None) -> int:
        """Return how many bytes of memory loading a field would take."""
        field = self.reader.field(mode, name)
        kind = wanted(field, dtype)
        loaded = self._loaded.get((mode, name, kind))
        rows = self.reader.rows(mode) - (loaded.shape[0] if loaded else 0)
        return rows * (field.nbytes // np.dtype(field.dtype).itemsize) * kind.itemsize

    def clear(self) -> None:
        """Free memory and addresses; needed where stored rows have changed."""
        self._loaded.clear()
        self._mapped.clear()


def wanted(field: Field, dtype: np.dtype[Any] | None) -> np.dtype[Any]:
    """Return the type that a field is given in, if floating ones are converted to `dtype`."""
    own = np.dtype(field.dtype)
    return own if dtype is None or own.kind != "f" else dtype
