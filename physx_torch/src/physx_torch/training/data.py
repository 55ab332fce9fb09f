"""StoredDataset: a stored dataset as PyTorch's `DataLoader` takes it."""

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
    """The samples of one mode of a dataset, by their number.

    Works with any number of `DataLoader` workers, forked or spawned: each process opens the dataset
    when it first reads, and what is pickled is only where it lies. The processes share the system's
    memory for the files, however many they are::

        samples = StoredDataset("sessions/run", "training", dtype="float32")
        for batch in DataLoader(samples, batch_size=32, shuffle=True, num_workers=2): ...

    For large batches, let PyTorch ask for whole batches, which it then has not to put together::

        sampler = BatchSampler(RandomSampler(samples), 1024, drop_last=False)
        for batch in DataLoader(samples, batch_size=None, sampler=sampler, num_workers=2): ...

    `physx_core.Dataset.batches` needs no `DataLoader` and is faster than either.

    Attributes:
        directory: The dataset's folder, absolute.
        mode: The mode.
        fields: Names of the fields that samples hold.
    """

    def __init__(
        self,
        directory: str | Path,
        mode: str = "training",
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
    ) -> None:
        """Look which samples there are; those that come later are not seen.

        Args:
            directory: The dataset's folder, or the session's folder that holds it.
            mode: The mode.
            fields: Names of the fields to give; None: all of them.
            dtype: NumPy type that floating fields are given in; None: their own.

        Raises:
            DatasetNotFoundError: There is no dataset.
            DatasetError: There is no such mode or field, or a partition is missing or damaged.
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
        """Return one sample for a number, and a batch for several numbers.

        Args:
            index: A number, a slice, or a list, array or tensor of numbers.

        Raises:
            IndexError: There is no such sample.
            DatasetError: A partition is missing, truncated or damaged.
        """
        if isinstance(index, (int, np.integer)):
            return {name: values[0] for name, values in self._batch([int(index)]).items()}
        if isinstance(index, slice):
            return self._batch(range(*index.indices(len(self))))
        return self._batch(index)

    def __getitems__(self, indices: Sequence[int]) -> list[Tensors]:
        """Return several samples, read at once: what `DataLoader` calls for a batch."""
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
        return {
            name: torch.from_numpy(self._converted(columns[name][rows])) for name in self.fields
        }

    def _converted(self, values: Any) -> Any:
        if self._dtype is None or values.dtype.kind != "f":
            return values
        return values.astype(self._dtype, copy=False)
