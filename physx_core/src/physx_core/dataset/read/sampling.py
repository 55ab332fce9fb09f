"""Reads batches of rows, in the order of writing or shuffled, into arrays that may be reused.

`physx_core.dataset.read.strategies.strategy` lists the read strategies; each is an `Epoch`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol, TypedDict

import numpy as np
from numpy.typing import DTypeLike

from physx_core.dataset.read.strategies.cache import ColumnCache, MemoryColumn, converted_dtype
from physx_core.dataset.read.strategies.disk import DiskColumn
from physx_core.dataset.read.strategies.ordered import in_order, ordered_rows, shuffled_rows
from physx_core.dataset.read.strategies.prefetch import ExactEpoch
from physx_core.dataset.read.strategies.strategy import Choice, Strategy, check_strategy
from physx_core.dataset.read.strategies.windows import WindowedEpoch
from physx_core.errors import ConfigError, DatasetError
from physx_core.statistics import Normalization
from physx_core.typing import Batch, Index


class BatchOptions(TypedDict, total=False):
    """Options of `Dataset.batches`, where they are described, and of `Subset.batches`."""

    shuffle: bool
    seed: int | Sequence[int] | None
    epochs: int | None
    fields: Sequence[str] | None
    dtype: DTypeLike | None
    reuse: bool
    normalize: bool | Mapping[str, Normalization]
    strategy: Choice
    block: int | None


class BatchReader:
    """Iterator over the batches of a mode or of a subset of its rows; usable once."""

    def __init__(
        self,
        columns: ColumnCache,
        mode: str,
        batch_size: int,
        subset: Index | None = None,
        *,
        shuffle: bool = False,
        seed: int | Sequence[int] | None = None,
        epochs: int | None = 1,
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
        reuse: bool = False,
        normalize: bool | Mapping[str, Normalization] = False,
        strategy: Choice = "auto",
        block: int | None = None,
    ) -> None:
        """Check the options, which are those of `Dataset.batches`; `subset` must be ascending.

        Here, `normalize` is the normalization to use, by field, or False.
        """
        if batch_size < 1:
            raise ConfigError(f"batch_size is {batch_size} but must be at least 1.")
        if epochs is not None and epochs < 0:
            raise ConfigError(f"epochs is {epochs} but cannot be negative.")
        reader = columns.reader
        self._names = list(dict.fromkeys(reader.mode(mode).fields if fields is None else fields))
        if not self._names:
            raise ConfigError("Batches need at least one field.")
        known = [reader.field(mode, name) for name in self._names]
        if not reader.rows(mode):
            raise DatasetError(f'Mode "{mode}" has no samples yet, so there are no batches.')
        self._columns, self._mode, self._subset = columns, mode, subset
        self._size, self._epochs = batch_size, epochs
        self._random = np.random.default_rng(seed) if shuffle else None
        self._dtype = None if dtype is None else np.dtype(dtype)
        self._strategy, self._block = check_strategy(strategy), block
        self._kinds = {
            field.name: (field.shape or (), converted_dtype(field, self._dtype)) for field in known
        }
        self._buffers = self._allocate(batch_size) if reuse else None
        scales = normalize if isinstance(normalize, Mapping) else {}
        self._scales = [
            (name, np.asarray(scales[name].mean, kind), np.asarray(scales[name].std, kind))
            for name, (_, kind) in self._kinds.items()
            if name in scales and kind.kind == "f"
        ]

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of all epochs."""
        strategy, size, count = self._strategy, self._size, 0
        while self._epochs is None or count < self._epochs:
            if self._strategy is None and strategy in (None, "memory"):
                strategy = self._columns.choose_strategy(self._mode, self._names, self._dtype)
            epoch = self._begin(strategy or "memory")
            try:
                rows = epoch.rows
                for start in range(0, rows, size):
                    batch = self._new_batch(size if start + size <= rows else rows - start)
                    epoch.fill(start, batch)
                    for name, mean, std in self._scales:
                        values = batch[name]
                        values -= mean
                        values /= std
                    yield batch
            finally:
                epoch.close()
            count += 1

    def _begin(self, strategy: Strategy) -> Epoch:
        mode, names, dtype, random = self._mode, self._names, self._dtype, self._random
        reader = self._columns.reader
        if strategy == "memory":
            loaded = [self._columns.load(mode, name, dtype) for name in names]
            return MemoryEpoch(loaded, self._order(), reader.rows(mode))
        for name in names:
            reader.check(mode, name)
        if strategy == "disk exact" and random is not None:
            return ExactEpoch(self._columns, mode, names, dtype, random, self._subset)
        disk = [in_order(reader, mode, DiskColumn(reader, mode, name, dtype)) for name in names]
        return WindowedEpoch(disk, random, self._subset, self._block)

    def _order(self) -> Index | None:
        """Return the stored rows of an epoch; None for the first stored rows."""
        reader, mode = self._columns.reader, self._mode
        if self._random is None:
            return ordered_rows(reader, mode, self._subset)
        return shuffled_rows(reader, mode, self._subset, self._random)

    def _new_batch(self, size: int) -> Batch:
        if self._buffers is None:
            return self._allocate(size)
        if size == self._size:
            return self._buffers.copy()
        return {name: buffer[:size] for name, buffer in self._buffers.items()}

    def _allocate(self, size: int) -> Batch:
        return {name: np.empty((size, *shape), kind) for name, (shape, kind) in self._kinds.items()}


class Epoch(Protocol):
    """One pass over all rows; raises a `DatasetError` if a partition cannot be read.

    Attributes:
        rows: Number of rows.
    """

    rows: int

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows of each field into the arrays of a batch.

        Args:
            start: Number of rows read so far.
            batch: The fields in the requested order, with arrays of equal length.
        """

    def close(self) -> None:
        """Close open files."""


class MemoryEpoch:
    """A pass over rows in memory, in an exact permutation.

    Attributes:
        rows: Number of rows.
    """

    def __init__(self, columns: list[MemoryColumn], order: Index | None, rows: int) -> None:
        """Begin a pass.

        Args:
            columns: The fields.
            order: The stored rows to read; None: the first `rows`.
            rows: Number of rows of the mode.
        """
        self.rows = rows if order is None else len(order)
        self._arrays = [column.array for column in columns]
        self._takes = [array.take for array in self._arrays]
        self._order = order

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows: see `Epoch`."""
        outs = list(batch.values())
        stop = start + len(outs[0])
        if self._order is None:
            for array, out in zip(self._arrays, outs):  # noqa: B905 (the hot path)
                out[...] = array[start:stop]
        else:
            index = self._order[start:stop]
            for take, out in zip(self._takes, outs):  # noqa: B905
                take(index, 0, out, "clip")  # all modes but the default write directly to `out`

    def close(self) -> None:
        """Do nothing: the columns are kept for the next epoch."""
