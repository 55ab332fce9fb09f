"""Reads batches of rows, in the order of the rows or shuffled, into arrays that may be reused."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypedDict

import numpy as np
from numpy.typing import DTypeLike

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.batch_arrays import BatchArrays
from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.read.shuffling import (
    ItemOrder,
    OrderName,
    check_order,
    choose_order,
    key_of,
    make_order,
)
from physx_core.errors import ConfigError, DatasetError
from physx_core.fields import free_axes
from physx_core.normalization import Normalization
from physx_core.packing import packed_fields
from physx_core.typing import Batch


class BatchOptions(TypedDict, total=False):
    """Options of `Dataset.batches`, where they are described."""

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
    """Iterator over the batches of a mode; usable once."""

    def __init__(
        self,
        columns: ColumnCache,
        mode: str,
        batch_size: int,
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
        """Check the options, which are those of `Dataset.batches`.

        Here, `normalize` is the normalization to use, by field, or False.
        """
        if batch_size < 1:
            raise ConfigError(f"batch_size is {batch_size} but must be at least 1.")
        if epochs is not None and epochs < 0:
            raise ConfigError(f"epochs is {epochs} but cannot be negative.")
        if first < 0:
            raise ConfigError(f"first is {first} but cannot be negative.")
        reader = columns.reader
        stored = reader.mode(mode).fields
        added = packed_fields(free_axes(stored.values())).keys() - stored.keys()
        self._named = None if fields is None else [name for name in fields if name in added]
        wanted = stored if fields is None else [name for name in fields if name not in added]
        self._names = list(dict.fromkeys(wanted))
        if not self._names:
            raise ConfigError("Batches need at least one field.")
        known = [reader.field(mode, name) for name in self._names]
        if not reader.rows(mode):
            raise DatasetError(f'Mode "{mode}" has no samples yet, so there are no batches.')
        self._columns, self._mode = columns, mode
        self._size, self._epochs, self._first = batch_size, epochs, first
        self._order: OrderName | None = "stored" if not shuffle else order and check_order(order)
        self._key = key_of(secrets.randbits(64) if seed is None else seed)
        self._dtype = None if dtype is None else np.dtype(dtype)
        self._is_packed = any(field.free_axis for field in known)
        kinds = {
            field.name: (field.entry_shape, field.converted_dtype(self._dtype)) for field in known
        }
        self._arrays = BatchArrays({} if self._is_packed else kinds, batch_size, reuse=reuse)
        scales = normalize if isinstance(normalize, Mapping) else {}
        self._scales = {
            name: replace(
                scales[name],
                mean=np.asarray(scales[name].mean, kind),
                std=np.asarray(scales[name].std, kind),
            )
            for name, (_, kind) in kinds.items()
            if name in scales and kind.kind == "f"
        }

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of all epochs."""
        size, first = self._size, ModeRows(self._columns, self._mode)
        number, skipped = divmod(self._first, -(-first.count // size))
        while self._epochs is None or number < self._epochs:
            rows = ModeRows(self._columns, self._mode)
            rows.loads = self._is_packed
            order = self._order_of(number, rows)
            epoch = None if self._is_packed else rows.epoch(self._names, self._dtype, order)
            try:
                for start in range(skipped * size, rows.count, size):
                    stop = min(start + size, rows.count)
                    if epoch is None:
                        batch = rows.packed(
                            self._names, order.items(start, stop), self._dtype, self._named
                        )
                    else:
                        batch = self._arrays.take(stop - start)
                        epoch.fill(start, batch)
                    for name, scale in self._scales.items():
                        values = batch[name]
                        if scale.log:
                            np.log(values, out=values)
                        values -= scale.mean
                        values /= scale.std
                    yield batch
            finally:
                if epoch is not None:
                    epoch.close()
            number, skipped = number + 1, 0

    def _order_of(self, number: int, rows: ModeRows) -> ItemOrder:
        name = self._order or choose_order(rows.count, rows.row_nbytes)
        return make_order(name, rows.count, rows.row_nbytes, key_of(self._key, number))
