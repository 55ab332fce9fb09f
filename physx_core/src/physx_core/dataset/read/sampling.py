"""Batches: rows in the order of writing or shuffled, gathered into arrays that may be reused.

`physx_core.dataset.read.strategy` says how rows can be read; each way is an `Epoch`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from physx_core.dataset.read.cache import ColumnCache, Index, MemoryColumn, wanted
from physx_core.dataset.read.disk import DiskColumn
from physx_core.dataset.read.prefetch import ExactEpoch
from physx_core.dataset.read.strategy import Strategy
from physx_core.dataset.read.windows import WindowedEpoch
from physx_core.errors import ConfigError, DatasetError
from physx_core.statistics import Normalization
from physx_core.typing import Batch


@dataclass(frozen=True)
class Batches:
    """One request for batches, see `Dataset.batches`; iterating makes them.

    Attributes:
        columns: Columns in memory, and the reader of the others.
        mode: Name of the mode.
        names: Names of the fields.
        batch_size: Rows of a batch.
        epochs: How often to go through all rows; None: without end.
        random: Draws a permutation for each epoch; None: the order of the rows.
        dtype: Type that floating fields are converted to; None: each keeps its own.
        reuse: Whether every batch is given in the same arrays.
        strategy: How rows are read; None: as suits their size and the free memory.
        normalization: What normalizes fields, by name; other fields stay as they are.
        subset: The only rows to give, rising; None: all.
    """

    columns: ColumnCache
    mode: str
    names: Sequence[str]
    batch_size: int
    epochs: int | None
    random: np.random.Generator | None
    dtype: np.dtype[Any] | None
    reuse: bool
    strategy: Strategy | None = None
    normalization: Mapping[str, Normalization] = field(default_factory=dict)
    subset: Index | None = None

    def __post_init__(self) -> None:
        """Check that there is something to give.

        Raises:
            ConfigError: `batch_size` or `epochs` is out of range, or no field is asked for.
            DatasetError: A field does not exist, or there are no samples.
        """
        if self.batch_size < 1:
            raise ConfigError(f"batch_size is {self.batch_size} but must be at least 1.")
        if self.epochs is not None and self.epochs < 0:
            raise ConfigError(f"epochs is {self.epochs} but cannot be negative.")
        if not self.names:
            raise ConfigError("Batches need at least one field.")
        for name in self.names:
            self.columns.reader.field(self.mode, name)
        if not self.columns.reader.rows(self.mode):
            raise DatasetError(
                f'Mode "{self.mode}" has no samples yet, so there are no batches to read.'
            )

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of all epochs."""
        form, strategy, size, count = _Form(self), self.strategy, self.batch_size, 0
        while self.epochs is None or count < self.epochs:
            if self.strategy is None and strategy in (None, "memory"):
                strategy = self.columns.strategy(self.mode, self.names, self.dtype)
            epoch = self._begin(strategy or "memory")
            try:
                rows = epoch.rows
                for start in range(0, rows, size):
                    batch = form.batch(size if start + size <= rows else rows - start)
                    epoch.fill(start, batch)
                    if form.scales:
                        form.normalize(batch)
                    yield batch
            finally:
                epoch.close()
            count += 1

    def _begin(self, strategy: Strategy) -> Epoch:
        mode, names, dtype, random = self.mode, self.names, self.dtype, self.random
        if strategy == "memory":
            loaded = [self.columns.load(mode, name, dtype) for name in names]
            return MemoryEpoch(loaded, random, self.subset)
        for name in names:
            self.columns.reader.check(mode, name)
        if strategy == "disk exact" and random is not None:
            return ExactEpoch(self.columns, mode, names, dtype, random, self.subset)
        disk = [DiskColumn(self.columns.reader, mode, name, dtype) for name in names]
        return WindowedEpoch(disk, random, self.subset)


class Epoch(Protocol):
    """One pass over all rows.

    Attributes:
        rows: How many rows there are.
    """

    rows: int

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows of each field into the arrays of a batch.

        Args:
            start: How many rows were given before.
            batch: The fields in the order of the request, with arrays of one length.
        """

    def close(self) -> None:
        """Close what is open."""


class MemoryEpoch:
    """A pass over rows in memory, in an exact permutation.

    Attributes:
        rows: How many rows there are.
    """

    def __init__(
        self,
        columns: list[MemoryColumn],
        random: np.random.Generator | None,
        subset: Index | None = None,
    ) -> None:
        self.rows = columns[0].shape[0] if subset is None else len(subset)
        self._arrays = [column.array for column in columns]
        self._takes = [array.take for array in self._arrays]
        self._order = subset
        if random is not None:
            self._order = random.permutation(self.rows if subset is None else subset)

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
                take(index, 0, out, "clip")  # any mode but the default writes straight into `out`

    def close(self) -> None:
        """Do nothing: the columns are kept for the next epoch."""


class _Form:
    """The arrays that batches are given in, and what is done to them last.

    Attributes:
        scales: Field, mean and deviation, for each field to normalize.
    """

    def __init__(self, request: Batches) -> None:
        fields = [request.columns.reader.field(request.mode, name) for name in request.names]
        self._kinds = {of.name: (of.shape or (), wanted(of, request.dtype)) for of in fields}
        self._size = request.batch_size
        self._buffers = self._allocate(self._size) if request.reuse else None
        self.scales = [
            (name, np.asarray(known.mean, kind), np.asarray(known.std, kind))
            for name, (_, kind) in self._kinds.items()
            if (known := request.normalization.get(name)) and kind.kind == "f"
        ]

    def batch(self, size: int) -> Batch:
        """Return a batch of `size` rows to fill."""
        if self._buffers is None:
            return self._allocate(size)
        if size == self._size:
            return self._buffers.copy()
        return {name: buffer[:size] for name, buffer in self._buffers.items()}

    def normalize(self, batch: Batch) -> None:
        """Normalize in place."""
        for name, mean, std in self.scales:
            values = batch[name]
            values -= mean
            values /= std

    def _allocate(self, size: int) -> Batch:
        return {name: np.empty((size, *shape), kind) for name, (shape, kind) in self._kinds.items()}
