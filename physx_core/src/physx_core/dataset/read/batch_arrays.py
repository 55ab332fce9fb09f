"""BatchArrays: the arrays that batches are returned in, new ones or always the same."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from physx_core.typing import Batch


class BatchArrays:
    """Allocates the arrays of batches."""

    def __init__(
        self, kinds: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]], size: int, *, reuse: bool
    ) -> None:
        """Allocate the arrays if they are reused.

        Args:
            kinds: Shape of a row and type of each field.
            size: Largest number of rows in a batch.
            reuse: Whether every batch is in the same arrays.
        """
        self._kinds, self._size = kinds, size
        self._reused = self._allocate(size) if reuse else None

    def take(self, size: int) -> Batch:
        """Return the arrays of a batch of `size` rows, by field."""
        if self._reused is None:
            return self._allocate(size)
        if size == self._size:
            return self._reused.copy()
        return {name: array[:size] for name, array in self._reused.items()}

    def _allocate(self, size: int) -> Batch:
        return {name: np.empty((size, *shape), kind) for name, (shape, kind) in self._kinds.items()}
