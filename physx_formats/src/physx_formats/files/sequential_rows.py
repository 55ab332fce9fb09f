"""SequentialRows: a column of Parquet files, of which the next rows are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.typing import Array


class SequentialRows:
    """The rows of a field, read in sequence; see `Column`.

    Attributes:
        dtype: Type of the values.
        shape: Shape of all rows, shape (rows, ...).
        unit: Unit of the values.
        problem: Why they cannot be read.
    """

    unit = problem = ""

    def __init__(
        self, files: Sequence[Any], name: str, dtype: np.dtype[Any], shape: Sequence[int]
    ) -> None:
        """Keep where they are.

        Args:
            files: The Parquet files in order.
            name: Name of the column.
            dtype: Type of the values.
            shape: Shape of the field.
        """
        self.dtype, self.shape = dtype, (sum(file.metadata.num_rows for file in files), *shape)
        self._name = name
        self._batches = (b for file in files for b in file.iter_batches(columns=[name]))
        self._left = np.empty((0, *shape), dtype)

    def read(self, start: int, count: int) -> Array:
        """Return the next rows."""
        parts = [self._left]
        while sum(map(len, parts)) < count:
            parts.append(self._values(next(self._batches).column(0)))
        rows = np.concatenate(parts)
        found, self._left = rows[:count], rows[count:]
        return found

    def _values(self, array: Any) -> Array:
        """Return the rows of an Arrow array."""
        raise NotImplementedError
