"""The order of a mode's rows: which stored row each of its rows is."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.growing import GrowingRecords
from physx_core.dataset.read.order.records import (
    NO_RECORDS,
    NOTHING,
    Found,
    Places,
    RecordedEpisodes,
    Records,
)
from physx_core.dataset.store.episode_table import EPISODES, LOST, RECORDED, has_table, mode_index
from physx_core.dataset.store.manifest import Manifest, Mode
from physx_core.errors import DatasetError
from physx_core.typing import Array, Index

ReadColumn = Callable[[str, int, int], Array]

_COLUMNS = ("campaign", "episode", "count", "first_row", "rows", "part", "status")


@dataclass(eq=False)
class Order:
    """The rows of a mode with records, in order of campaign and number.

    Attributes:
        found: The episodes that count.
    """

    found: Found

    @cached_property
    def episodes(self) -> RecordedEpisodes:
        """The episodes that count."""
        return self.found.episodes

    @cached_property
    def places(self) -> Places:
        """Where their rows are stored."""
        return self.found.places

    @cached_property
    def last_records(self) -> Index:
        """Number of the last record of each episode."""
        return self.found.last

    @cached_property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.found.rows.sum())

    @property
    def is_stored(self) -> bool:
        """Whether they are the first stored rows."""
        first = self.places.first
        return not len(first) or (len(first) == 1 and first[0] == 0)

    @cached_property
    def index(self) -> Index | None:
        """The stored row of each row, shape (rows,); None if they are the first stored rows."""
        if self.is_stored:
            return None
        first, rows = self.places
        return np.repeat(first - self._starts, rows) + np.arange(self.rows)

    def stored(self, rows: Index) -> Index:
        """Return the stored rows of some rows, without the index of all."""
        if not len(rows):
            return rows
        piece = self.piece(rows)
        found: Index = self.places.first[piece] + rows - self._starts[piece]
        return found

    def piece(self, rows: Index) -> Index:
        """Return the numbers of the pieces that some rows belong to."""
        return self._starts.searchsorted(rows, "right") - 1

    def places_of(self, start: int, stop: int) -> Places:
        """Return where the rows of a range are stored, at least one row."""
        first, last = self.piece(np.array([start, stop - 1])).tolist()
        begins, rows = (column[first : last + 1].copy() for column in self.places)
        skipped = start - int(self._starts[first])
        begins[0], rows[0] = begins[0] + skipped, rows[0] - skipped
        rows[-1] -= int(self._starts[last] + self.places.rows[last]) - stop
        return Places(begins, rows)

    def pieces(self, start: int, stop: int) -> Iterator[tuple[int, int]]:
        """Yield the first stored row and the number of rows of each piece of a range of rows."""
        number = int(self._starts.searchsorted(start, "right")) - 1
        while start < stop:
            inside = start - int(self._starts[number])
            count = min(stop - start, int(self.places.rows[number]) - inside)
            yield int(self.places.first[number]) + inside, count
            number, start = number + 1, start + count

    @cached_property
    def _starts(self) -> Index:
        starts: Index = np.cumsum(self.places.rows) - self.places.rows
        return starts


class Orders:
    """The orders of a dataset's modes, extended whenever records or rows have come.

    Attributes:
        until_gap: Whether of the episodes that are recorded from now on only those before the first
            missing number count, as while another process writes.
    """

    def __init__(self, manifest: Manifest, read: ReadColumn) -> None:
        """Know nothing yet.

        Args:
            manifest: The dataset's contents, which may change.
            read: Returns some rows of a column of the table of episodes.
        """
        self.until_gap = False
        self._manifest, self._read = manifest, read
        self._numbering, self._done = -1, 0  # how many records have been read
        self._records: dict[str, GrowingRecords] = {}
        self._orders: dict[str, tuple[tuple[int, int, bool], Order]] = {}
        self._seen: dict[str, int] = {}  # records that were read when all episodes counted
        self._lock = threading.Lock()  # a training reads while its feeder appends

    def of(self, mode: str) -> Order | None:
        """Return the order of a mode; None if it has no records, so that all its rows count.

        Raises:
            DatasetError: If the table of episodes cannot be read or is invalid.
        """
        if mode not in RECORDED or not has_table(self._manifest):
            return None
        with self._lock:
            return self._newest(mode)

    def _newest(self, mode: str) -> Order | None:
        self._read_new()
        records = self._records.get(mode)
        if records is None:
            return Order(NOTHING) if self._manifest.info.get(LOST) else None
        known = self._manifest.modes.get(mode, Mode({}))
        state = known.rows, records.count, self.until_gap
        found = self._orders.get(mode)
        if found is None or found[0] != state:
            found = self._orders[mode] = state, self._find(mode, records)
        return found[1]

    def count(self, mode: str) -> int:
        """Return the number of valid records of a mode so far; 0 if it has none."""
        return self._records[mode].count if mode in self._records else 0

    def at(self, mode: str, records: int) -> Order | None:
        """Return the order of a mode by the first of its records; None: there are not so many.

        Raises:
            DatasetError: If the table of episodes is invalid.
        """
        with self._lock:
            now = self._newest(mode)
            if self.count(mode) < records:
                return None
            if now is not None and self.count(mode) == records and not self.until_gap:
                return now
            fresh, known = GrowingRecords(), self._records[mode]
            first = slice(records)
            fresh.add(known.records.take(first), known.places[first])
            return Order(self._resolved(mode, fresh))

    def places(self, mode: str) -> Index:
        """Return which rows of the table are the records of a mode, as `Found.record` counts."""
        return self._records[mode].places

    def records(self, mode: str) -> Records:
        """Return the records of a mode, as `Found.record` counts; there must be a table."""
        with self._lock:
            self._read_new()
        return self._records[mode].records if mode in self._records else NO_RECORDS

    def all(self, mode: str) -> Found:
        """Return all episodes of a mode that has an order, even those after a missing number."""
        known = self._manifest.modes.get(mode, Mode({}))
        return self._records[mode].find(Addresses(known)) if mode in self._records else NOTHING

    def _read_new(self) -> None:
        """Read the records that have come."""
        if EPISODES in self._manifest.problems:
            raise self._manifest.problems[EPISODES]
        if self._manifest.numbering != self._numbering:
            self._numbering, self._done = self._manifest.numbering, 0
            self._records, self._orders = {}, {}
        total = self._manifest.modes[EPISODES].rows
        if self._done == total:
            return
        table = Records(*(self._column(name, total) for name in _COLUMNS))
        about = self._column("mode_index", total)
        for mode in RECORDED:
            which = np.flatnonzero(about == mode_index(mode))
            if len(which):
                records = self._records.setdefault(mode, GrowingRecords())
                records.add(table.take(which), self._done + which)
        self._done = total

    def _column(self, name: str, stop: int) -> Index:
        return self._read(name, self._done, stop).astype(np.int64)

    def _resolved(self, mode: str, records: GrowingRecords) -> Found:
        try:
            return records.find(Addresses(self._manifest.modes.get(mode, Mode({}))))
        except ValueError as error:
            raise DatasetError(
                f'The table of episodes does not fit mode "{mode}": {error}. Restore it from a '
                "backup, or remove its records."
            ) from error

    def _find(self, mode: str, records: GrowingRecords) -> Order:
        found = self._resolved(mode, records)
        if not self.until_gap:
            self._seen[mode] = records.count
            return Order(found)
        counts = found.last < self._seen.get(mode, 0)
        counts[: found.before_gap] = True
        return Order(found.take(counts))
