"""RowStore: the values of the rows that a buffer keeps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from physx_core.dataset import Dataset
from physx_core.fields import Field
from physx_core.typing import Batch, Index

_BLOCK = 4096


class RowStore:
    """One preallocated array per field, with one row for each slot of a buffer."""

    def __init__(
        self,
        capacity: int,
        batch_size: int,
        fields: Mapping[str, Field],
        names: Sequence[str],
        data_type: str,
    ) -> None:
        """Allocate the arrays.

        Args:
            capacity: Number of slots.
            batch_size: Number of rows in a batch.
            fields: The stored fields by name.
            names: Those that batches contain; unknown ones are left out.
            data_type: Floating-point type of the batches.
        """
        kinds = {
            name: fields[name].row_kind
            if fields[name].free_axis
            else (fields[name].entry_shape, fields[name].converted_dtype(np.dtype(data_type)))
            for name in names
            if name in fields
        }
        self._arrays = {n: np.empty((capacity, *shape), kind) for n, (shape, kind) in kinds.items()}
        self._batch = {
            n: np.empty((batch_size, *shape), kind) for n, (shape, kind) in kinds.items()
        }

    def put(self, slots: Index, rows: Batch) -> None:
        """Copy rows into their slots; if several rows share a slot, the last one stays."""
        for name, array in self._arrays.items():
            array[slots] = rows[name]

    def read(self, slots: Index, dataset: Dataset, mode: str, index: Index) -> None:
        """Fill slots with the rows of a dataset at these indices."""
        view = dataset[mode]
        for start in range(0, len(slots), _BLOCK):
            part = slice(start, start + _BLOCK)
            self.put(slots[part], {name: view[name][index[part]] for name in self._arrays})

    def take(self, slots: Index) -> Batch:
        """Return the rows in some slots as a batch, valid until the next call."""
        for name, array in self._arrays.items():
            array.take(slots, 0, self._batch[name], "clip")
        return self._batch.copy()
