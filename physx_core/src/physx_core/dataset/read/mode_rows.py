"""ModeRows: the rows of a mode as they were at some time, though others may have come since."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.epochs import Epoch, Stored, begin_epoch
from physx_core.dataset.read.shuffling import ItemOrder
from physx_core.dataset.store.episode_table import EPISODES, TABLE_FIELDS
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.typing import Array, Index


class Snapshot(NamedTuple):
    """What identifies the rows of a mode at some time, among those that are only appended.

    Attributes:
        rows: Number of rows.
        records: Number of records in the table of episodes about it; 0 if its rows have none.
    """

    rows: int
    records: int = 0


class ModeRows:
    """The first rows of a mode, in the order that they have at a snapshot.

    Attributes:
        mode: Name of the mode.
        snapshot: The snapshot.
        order: Which stored rows they are; None: the first ones.
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
        orders = self._reader.orders
        if snapshot is None:
            self.order = self._reader.order(mode)
            records = 0 if self.order is None else orders.count(mode)
            snapshot = Snapshot(self._reader.rows(mode), records)
        else:
            self._reader.mode(mode)
            self.order = orders.at(mode, snapshot.records) if snapshot.records else None
            rows = self._reader.stored_rows(mode) if self.order is None else self.order.rows
            if rows < snapshot.rows:
                raise DatasetError(
                    f"Of the {snapshot.rows} samples of mode {mode!r} that there were in "
                    f"{self._reader.directory}, only {rows} are left."
                )
        self.snapshot = snapshot

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.snapshot.rows

    @property
    def fields(self) -> dict[str, Field]:
        """The fields by name."""
        return self._reader.mode(self.mode).fields

    @property
    def row_nbytes(self) -> int:
        """Bytes of a stored row, of all its fields."""
        return self._reader.row_nbytes(self.mode)

    @property
    def stored(self) -> Stored:
        """Returns the stored rows of some rows; None: they are the same."""
        return None if self.order is None or self.order.index is None else self.order.stored

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
        stored = self.stored
        column = self._columns.map(self.mode, name)
        column.check()
        out = np.empty((len(rows), *column.shape[1:]), column.dtype)
        column.gather(rows if stored is None else stored(rows), out)
        return out

    def read(self, name: str) -> Array:
        """Return all rows of a field."""
        if self.stored is None:
            return self._reader.read(self.mode, name, 0, self.count)
        return self.gather(name, np.arange(self.count))

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
        column = self._columns.map(EPISODES, name)
        out = np.empty((len(once), *column.shape[1:]), column.dtype)
        column.gather(records[once], out)
        found: Array = out[places]
        return found

    @property
    def episode_names(self) -> list[str]:
        """Names of the parameters and fields that episodes have once."""
        known = self._reader.mode(EPISODES).fields
        return [name for name in known if name not in {field.name for field in TABLE_FIELDS}]
