"""Reads batches of rows, in the order of the rows or shuffled, into arrays that may be reused."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import DTypeLike

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.epochs import Epoch, begin_epoch
from physx_core.dataset.read.shuffling import (
    OrderName,
    check_order,
    choose_order,
    key_of,
    make_order,
)
from physx_core.errors import ConfigError, DatasetError
from physx_core.statistics import Normalization
from physx_core.typing import Batch, Index


class BatchOptions(TypedDict, total=False):
    """Options of `Dataset.batches`, where they are described, and of `Subset.batches`."""

    shuffle: bool
    order: OrderName | None
    seed: int | Sequence[int] | None
    epochs: int | None
    first: int
    fields: Sequence[str] | None
    dtype: DTypeLike | None
    reuse: bool
    normalize: bool | Mapping[str, Normalization]


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
        order: OrderName | None = None,
        seed: int | Sequence[int] | None = None,
        epochs: int | None = 1,
        first: int = 0,
        fields: Sequence[str] | None = None,
        dtype: DTypeLike | None = None,
        reuse: bool = False,
        normalize: bool | Mapping[str, Normalization] = False,
    ) -> None:
        """Check the options, which are those of `Dataset.batches`; `subset` must be ascending.

        Here, `normalize` is the normalization to use, by field, or False.
        """
        if batch_size < 1:
            raise ConfigError(f"batch_size is {batch_size} but must be at least 1.")
        if epochs is not None and epochs < 0:
            raise ConfigError(f"epochs is {epochs} but cannot be negative.")
        if first < 0:
            raise ConfigError(f"first is {first} but cannot be negative.")
        reader = columns.reader
        self._names = list(dict.fromkeys(reader.mode(mode).fields if fields is None else fields))
        if not self._names:
            raise ConfigError("Batches need at least one field.")
        known = [reader.field(mode, name) for name in self._names]
        if not reader.rows(mode):
            raise DatasetError(f'Mode "{mode}" has no samples yet, so there are no batches.')
        self._columns, self._mode, self._subset = columns, mode, subset
        self._size, self._epochs, self._first = batch_size, epochs, first
        self._order: OrderName | None = "stored" if not shuffle else order and check_order(order)
        self._key = key_of(secrets.randbits(64) if seed is None else seed)
        self._dtype = None if dtype is None else np.dtype(dtype)
        self._kinds = {
            field.name: (field.shape or (), field.converted_dtype(self._dtype)) for field in known
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
        size = self._size
        number, skipped = divmod(self._first, -(-self._count // size))
        while self._epochs is None or number < self._epochs:
            count = self._count
            epoch = self._begin(number, count)
            try:
                for start in range(skipped * size, count, size):
                    batch = self._new_batch(size if start + size <= count else count - start)
                    epoch.fill(start, batch)
                    for name, mean, std in self._scales:
                        values = batch[name]
                        values -= mean
                        values /= std
                    yield batch
            finally:
                epoch.close()
            number, skipped = number + 1, 0

    @property
    def _count(self) -> int:
        """Number of rows of an epoch that begins now."""
        reader, subset = self._columns.reader, self._subset
        return reader.rows(self._mode) if subset is None else len(subset)

    def _begin(self, number: int, count: int) -> Epoch:
        row_nbytes = self._columns.reader.row_nbytes(self._mode)
        name = self._order or choose_order(count, row_nbytes)
        order = make_order(name, count, row_nbytes, key_of(self._key, number))
        return begin_epoch(
            self._columns, self._mode, self._names, self._dtype, order, self._stored_rows()
        )

    def _stored_rows(self) -> Callable[[Index], Index] | None:
        """Return the function that gives the stored rows of some rows; None: they are the same."""
        order, subset = self._columns.reader.order(self._mode), self._subset
        index = None if order is None or order.index is None else order
        if subset is None:
            return None if index is None else index.stored
        if index is None:
            return subset.__getitem__
        return lambda rows: index.stored(subset[rows])

    def _new_batch(self, size: int) -> Batch:
        if self._buffers is None:
            return self._allocate(size)
        if size == self._size:
            return self._buffers.copy()
        return {name: buffer[:size] for name, buffer in self._buffers.items()}

    def _allocate(self, size: int) -> Batch:
        return {name: np.empty((size, *shape), kind) for name, (shape, kind) in self._kinds.items()}
