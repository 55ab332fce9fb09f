"""StoredDataset: a stored dataset for PyTorch's `DataLoader`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike

from physx_core import Dataset

Tensors = dict[str, torch.Tensor]


class StoredDataset(torch.utils.data.Dataset[Tensors]):
    """The samples of one mode of a dataset, by index.

    Works with any number of `DataLoader` workers, forked or spawned: each process opens the dataset
    on its first read, and only the path is pickled. All processes share the system's file cache::

        samples = StoredDataset("sessions/run", "training", dtype="float32")
        for batch in DataLoader(samples, batch_size=32, shuffle=True, num_workers=2): ...

    For large batches, have PyTorch request whole batches, which it then need not assemble::

        sampler = BatchSampler(RandomSampler(samples), 1024, drop_last=False)
        for batch in DataLoader(samples, batch_size=None, sampler=sampler, num_workers=2): ...

    `physx_core.Dataset.batches` needs no `DataLoader` and is faster than either.

    Attributes:
        directory: The dataset's folder, as an absolute path.
        mode: The mode.
        fields: Names of the samples' fields.
    """

    def __init__(
        self,
        directory: str | Path,
        mode: str = "training",
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
    ) -> None:
        """Select the current samples; samples added later are not included.

        Args:
            directory: The dataset's folder, or the session's folder that contains it.
            mode: The mode.
            fields: Names of the fields to read; None: all.
            dtype: NumPy type of floating-point fields; None: their own.

        Raises:
            DatasetNotFoundError: If there is no dataset.
            DatasetError: If a mode or field does not exist, or a partition is missing or damaged.
        """
        with Dataset.open(directory) as dataset:
            self.directory, self.mode = dataset.directory.absolute(), mode
            self.fields = list(dataset.fields(mode) if fields is None else fields)
            self._length = dataset.num_samples(mode)
            for name in self.fields:
                _ = dataset[mode][name]
        self._dtype = None if dtype is None else np.dtype(dtype)
        self._opened: Dataset | None = None

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: Any) -> Tensors:
        """Return one sample for an index, and a batch for several indices.

        Args:
            index: An index, a slice, or a list, array or tensor of indices.

        Raises:
            IndexError: If a sample does not exist.
            DatasetError: If a partition is missing, truncated or damaged.
        """
        if isinstance(index, (int, np.integer)):
            return {name: values[0] for name, values in self._batch([int(index)]).items()}
        if isinstance(index, slice):
            return self._batch(range(*index.indices(len(self))))
        return self._batch(index)

    def __getitems__(self, indices: Sequence[int]) -> list[Tensors]:
        """Return several samples, read together; called by `DataLoader` for a batch."""
        batch = self._batch(indices)
        columns = zip(*(values.unbind() for values in batch.values()), strict=True)
        return [dict(zip(batch, row, strict=True)) for row in columns]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_opened": None}

    def _batch(self, index: Any) -> Tensors:
        rows = np.asarray(index, np.intp)
        if rows.size and (rows.min() < -self._length or rows.max() >= self._length):
            raise IndexError(f"{index} is out of range: there are {self._length} samples.")
        rows = np.where(rows < 0, rows + self._length, rows)
        if self._opened is None:
            self._opened = Dataset.open(self.directory)
        columns = self._opened[self.mode]
        return {name: torch.from_numpy(self._convert(columns[name][rows])) for name in self.fields}

    def _convert(self, values: Any) -> Any:
        if self._dtype is None or values.dtype.kind != "f":
            return values
        return values.astype(self._dtype, copy=False)
