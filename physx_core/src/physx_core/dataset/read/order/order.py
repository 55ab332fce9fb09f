"""The order of a mode's rows: which stored row each of its rows is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from physx_core.config import MODES
from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.records import Places, RecordedEpisodes, Records, resolve
from physx_core.dataset.store.episode_table import EPISODES, LOST, has_table, mode_index
from physx_core.dataset.store.manifest import Manifest, Mode
from physx_core.errors import DatasetError
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array, Index

ReadColumn = Callable[[str], Array]

_COLUMNS = ("campaign", "episode", "count", "first_row", "rows", "part", "status")


@dataclass(eq=False)
class Order:
    """The rows of a mode with records, in order of campaign and number.

    Attributes:
        episodes: The episodes that count.
        places: Where their rows are stored.
        statistics: Statistics of the rows, by field, once they are known.
    """

    episodes: RecordedEpisodes
    places: Places
    statistics: dict[str, RunningStatistics] = field(default_factory=dict)

    @cached_property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.places.rows.sum())

    @cached_property
    def index(self) -> Index | None:
        """The stored row of each row, shape (rows,); None if they are the first stored rows."""
        first, rows = self.places
        if not len(first) or (len(first) == 1 and first[0] == 0):
            return None
        return np.repeat(first - self._starts, rows) + np.arange(self.rows)

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
    """The orders of a dataset's modes, made anew whenever records or rows have come.

    Attributes:
        until_gap: Whether of the episodes that are recorded from now on only those before the first
            missing number count, as while another process writes.
    """

    def __init__(self, manifest: Manifest, read: ReadColumn) -> None:
        """Know nothing yet.

        Args:
            manifest: The dataset's contents, which may change.
            read: Returns a column of the table of episodes.
        """
        self.until_gap = False
        self._manifest, self._read = manifest, read
        self._state: tuple[int, int] = -1, -1
        self._records: dict[str, Records] = {}
        self._orders: dict[str, tuple[tuple[int, bool], Order]] = {}
        self._seen: dict[str, int] = {}  # records that were read when all episodes counted

    def of(self, mode: str) -> Order | None:
        """Return the order of a mode; None if it has no records, so that all its rows count.

        Raises:
            DatasetError: If the table of episodes cannot be read or is invalid.
        """
        records = self._records_of(mode)
        if records is None:
            return None
        known = self._manifest.modes.get(mode, Mode({}))
        state = known.rows, self.until_gap
        found = self._orders.get(mode)
        if found is None or found[0] != state:
            found = self._orders[mode] = state, self._resolve(mode, records, Addresses(known))
        return found[1]

    def _records_of(self, mode: str) -> Records | None:
        if mode not in MODES or not has_table(self._manifest):
            return None
        if EPISODES in self._manifest.problems:
            raise self._manifest.problems[EPISODES]
        state = self._manifest.generation, self._manifest.modes[EPISODES].rows
        if state != self._state:
            self._records, self._orders = self._read_records(), {}
            self._state = state
        found = self._records.get(mode)
        if found is None and self._manifest.info.get(LOST):
            return Records(*(np.zeros(0, np.int64) for _ in _COLUMNS))  # no row has a record
        return found

    def _read_records(self) -> dict[str, Records]:
        table = Records(*(self._column(name) for name in _COLUMNS))
        about = self._column("mode_index")
        return {
            mode: table.take(about == mode_index(mode))
            for mode in MODES
            if (about == mode_index(mode)).any()
        }

    def _column(self, name: str) -> Index:
        return self._read(name).astype(np.int64)

    def _resolve(self, mode: str, records: Records, addresses: Addresses) -> Order:
        try:
            records = records.take(records.is_valid)
            if not self.until_gap:
                self._seen[mode] = len(records.rows)
            seen = self._seen.get(mode, 0) if self.until_gap else None
            return Order(*resolve(records, addresses, seen))
        except ValueError as error:
            raise DatasetError(
                f'The table of episodes does not fit mode "{mode}": {error}. Restore it from a '
                "backup, or remove its records."
            ) from error
