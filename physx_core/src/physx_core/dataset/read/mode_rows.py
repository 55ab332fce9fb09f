"""ModeRows: the rows of a mode as they were at some time, though others may have come since."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from xxhash import xxh32_intdigest

from physx_core.dataset.read.access.columns import ColumnCache, MemoryColumn
from physx_core.dataset.read.access.mapping import MappedColumn
from physx_core.dataset.read.epochs import Epoch, Stored, begin_epoch
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.shuffling import ItemOrder
from physx_core.dataset.store.episode_table import EPISODES, TABLE_FIELDS
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.partition.segment import RowsCheck, rows_per_block
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.packing import pack, ranges, split
from physx_core.typing import Array, Batch, Index

_BLOCK = 2**15  # rows
_SMALL_ROW = 1024  # bytes from which a copy for each row is faster than one for each entry


class Snapshot(NamedTuple):
    """What identifies the rows of a mode at some time, among those that are only appended.

    Attributes:
        rows: Number of rows.
        records: Number of records in the table of episodes about it; 0 if its rows have none.
        digest: Digest of what these rows are, in the records or by their partitions.
    """

    rows: int
    records: int
    digest: int


class ModeRows:
    """The first rows of a mode, in the order that they have at a snapshot.

    Attributes:
        mode: Name of the mode.
        count: Number of rows.
        order: Which stored rows they are; None: the first ones.
        loads: Whether fields from which rows are gathered are read into memory if they fit there.
    """

    def __init__(self, columns: ColumnCache, mode: str, snapshot: Snapshot | None = None) -> None:
        """Look at the rows.

        Args:
            columns: The columns.
            mode: Name of the mode.
            snapshot: The snapshot; None: now.

        Raises:
            DatasetError: If there is no such mode, or rows of the snapshot are missing.
        """
        self.mode, self._columns, self._reader = mode, columns, columns.reader
        self._numbering = self._reader.manifest.numbering
        self.loads = False
        self._used: dict[str, tuple[int, MemoryColumn | MappedColumn]] = {}
        self._ends: dict[str, tuple[int, Index]] = {}
        orders = self._reader.orders
        if snapshot is None:
            self.order = self._reader.order(mode)
            self._records = 0 if self.order is None else orders.count(mode)
            self.count = self._reader.rows(mode)
        else:
            self._reader.mode(mode)
            self.count, self._records = snapshot.rows, snapshot.records
            self.order = orders.at(mode, snapshot.records) if snapshot.records else None
            rows = self._reader.stored_rows(mode) if self.order is None else self.order.rows
            is_lost = bool(snapshot.records) and self.order is None
            if is_lost or rows < snapshot.rows or self.snapshot != snapshot:
                raise DatasetError(
                    f'The {snapshot.rows} samples of mode "{mode}" that there were in '
                    f"{self._reader.directory} are no longer there as they were: some were "
                    "removed, or they were compacted."
                )

    @cached_property
    def snapshot(self) -> Snapshot:
        """What identifies the rows; read once, as it takes a pass over the records."""
        return Snapshot(self.count, self._records, self._digest())

    def check(self) -> None:
        """Check that the rows are still there.

        Raises:
            DatasetError: If some were removed in this process, or compacted.
        """
        if self._reader.manifest.numbering != self._numbering:
            raise DatasetError(
                f'Samples of mode "{self.mode}" in {self._reader.directory} were removed, or '
                "compacted, since the batches were opened: open them again."
            )

    def _digest(self) -> int:
        """Return the digest of the records, or of the partitions of the rows."""
        if self._records:
            known = self._reader.orders.records(self.mode)
            content = b"".join(column[: self._records].tobytes() for column in known)
        else:
            before = itertools.accumulate((p.rows for p in self._parts), initial=0)
            keys = [part.key for part, start in zip(self._parts, before, strict=False)
                    if start < self.count]  # fmt: skip
            content = repr(keys).encode()
        return int(xxh32_intdigest(content))

    @property
    def _parts(self) -> list[Partition]:
        return self._reader.mode(self.mode).with_rows

    @property
    def fields(self) -> dict[str, Field]:
        """The fields by name."""
        return self._reader.mode(self.mode).fields

    @property
    def row_nbytes(self) -> int:
        """Bytes of a stored row, of all its fields."""
        return self._reader.row_nbytes(self.mode)

    @property
    def reader(self) -> Reader:
        """Reads the stored rows."""
        return self._reader

    @property
    def stored(self) -> Stored:
        """Returns the stored rows of some rows; None: they are the same."""
        return None if self.order is None or self.order.is_stored else self.order.stored

    def epoch(
        self, names: list[str], dtype: np.dtype[Any] | None, order: ItemOrder, rows: Stored = None
    ) -> Epoch:
        """Begin a pass over items.

        Args:
            names: Names of the fields.
            dtype: Type that floating-point fields are converted to; None: no conversion.
            order: The order of the items.
            rows: Returns the row numbers of some items; None: they are the same.
        """
        stored = self.stored
        both = stored
        if rows is not None:
            chosen = rows
            both = chosen if stored is None else lambda items: stored(chosen(items))
        return begin_epoch(self._columns, self.mode, names, dtype, order, both)

    def gather(self, name: str, rows: Index) -> Array:
        """Return some rows of a field, shape (n, *field shape)."""
        if self.fields[name].free_axis:
            return split(*self.entries(name, rows))
        stored = self.stored
        column = self._column(name)
        out = np.empty((len(rows), *column.shape[1:]), column.dtype)
        column.gather(rows if stored is None else stored(rows), out)
        return out

    def entries(
        self,
        name: str,
        rows: Index,
        dtype: np.dtype[Any] | None = None,
        allocate: Callable[[tuple[int, ...], np.dtype[Any]], Array] = np.empty,
    ) -> tuple[Array, Index]:
        """Return the entries of some rows of a field with a free axis, end to end.

        Args:
            name: Name of the field.
            rows: Row numbers, shape (n,).
            dtype: Type that floating-point fields are converted to; None: no conversion.
            allocate: Returns an array of a shape and a type for the entries.

        Returns:
            The entries, and how many each row has, shape (n,).
        """
        field, column = self.fields[name], self._column(name)
        bounds = self._bounds(field.free_axis)
        stored = rows if self.stored is None else self.stored(rows)
        starts = bounds[stored]
        counts = bounds[stored + 1] - starts
        out = allocate((int(counts.sum()), *field.entry_shape), field.converted_dtype(dtype))
        if not out.size:
            return out, counts
        plain = out if out.dtype == column.dtype else np.empty(out.shape, column.dtype)
        if len(out) * field.nbytes < _SMALL_ROW * len(rows):
            column.gather(ranges(starts, counts), plain)
        else:
            column.copy(starts, counts, plain)
        if plain is not out:
            out[:] = plain
        return out, counts

    def packed(
        self,
        names: Sequence[str],
        rows: Index,
        dtype: np.dtype[Any] | None = None,
        named: Sequence[str] | None = None,
    ) -> Batch:
        """Return some rows as a batch in which free axes are packed: see `packing.pack`.

        Args:
            names: Names of the fields.
            rows: Row numbers, shape (n,).
            dtype: Type that floating-point fields are converted to; None: no conversion.
            named: See `packing.pack`.
        """
        fields, found, sizes = {name: self.fields[name] for name in names}, {}, {}
        for name, field in fields.items():
            if field.free_axis:
                found[name], sizes[field.free_axis] = self.entries(name, rows, dtype)
            else:
                values = self.gather(name, rows)
                found[name] = values.astype(field.converted_dtype(dtype), copy=False)
        return pack(fields, found, sizes, named)

    def windows(self, name: str, first: Index, count: int) -> Array:
        """Return consecutive rows of a field from some rows on, shape (n, count, *field shape)."""
        stored, begin = self.stored, first
        if stored is not None:
            begin, end = stored(first), stored(first + (count - 1))
            if (end - begin != count - 1).any():  # episodes in several parts
                found = self.gather(name, (first[:, None] + np.arange(count)).ravel())
                return found.reshape(len(first), count, *found.shape[1:])
        return self._column(name).windows(begin, count)

    def _bounds(self, axis: str) -> Index:
        """Return the first stored entry of each stored row, and the end; kept while rows stay."""
        generation = self._reader.manifest.generation
        known = self._ends.get(axis)
        if known is None or known[0] != generation:
            known = self._ends[axis] = generation, self._reader.bounds(self.mode, axis)
        return known[1]

    def _column(self, name: str) -> MemoryColumn | MappedColumn:
        """Return a field; it is in memory if it was, or may be and fits when it is first used."""
        generation = self._reader.manifest.generation
        known = self._used.get(name)
        if known is None or known[0] != generation:
            loads = self.loads and known is None
            column = self._columns.by_index(self.mode, name, loads=loads)
            known = self._used[name] = generation, column
        else:
            known[1].check()
        return known[1]

    def blocks(self, names: Sequence[str], start: int, stop: int) -> Iterator[tuple[int, Batch]]:
        """Yield fields of the rows `start` to `stop` in blocks, each valid until the next.

        Sealed partitions that are read completely are compared with their checksums.

        Args:
            names: Names of the fields.
            start: First row.
            stop: Row before which to stop.

        Yields:
            The first row of a block, and field name to array of shape (n, *field shape).
        """
        count = min([_BLOCK, *(rows_per_block(self.fields[name].nbytes) for name in names)])
        kinds = {n: of.row_kind for n, of in self.fields.items()}
        buffers = {
            n: np.empty((min(count, stop - start), *kinds[n][0]), kinds[n][1]) for n in names
        }
        checks: dict[str, dict[int, RowsCheck]] = {name: {} for name in names}
        for first in range(start, stop, count):
            block = {name: buffer[: stop - first] for name, buffer in buffers.items()}
            for name, out in block.items():
                if self.stored is not None:
                    out[:] = self.gather(name, np.arange(first, first + len(out)))
                elif self.fields[name].free_axis:
                    out[:] = self._reader.read(self.mode, name, first, first + len(out))
                else:
                    self._reader.read_into(out, self.mode, name, first, checks[name])
            yield first, block

    def episode_values(self, name: str, rows: Index) -> Array:
        """Return what the episode of each row has once, shape (n, *shape of the field).

        Args:
            name: Name of a field of the table of episodes.
            rows: Row numbers, shape (n,).

        Raises:
            DatasetError: If the rows have no recorded episodes, or there is no such field.
        """
        if self.order is None:
            raise DatasetError(f'The rows of mode "{self.mode}" have no recorded episodes.')
        self._reader.field(EPISODES, name)
        entries = np.searchsorted(self.order.episodes.first, rows, "right") - 1
        records = self._reader.orders.places(self.mode)[self.order.last_records]
        once, places = np.unique(entries, return_inverse=True)
        found: Array = self._columns.take(EPISODES, name, records[once])[places]
        return found

    @property
    def episode_names(self) -> list[str]:
        """Names of the parameters and fields that episodes have once."""
        known = self._reader.mode(EPISODES).fields
        return [name for name in known if name not in {field.name for field in TABLE_FIELDS}]
