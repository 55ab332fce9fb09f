"""The records about one mode and what counts of them, extended as records and rows come."""

from __future__ import annotations

import numpy as np

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.records import (
    NOTHING,
    Found,
    Records,
    check_shared,
    reach,
    resolve,
)
from physx_core.typing import Index

Key = tuple[int, int]

_NONE = np.zeros(0, np.int64)
_SOME = 64


class GrowingRecords:
    """Finds what counts again only from the first number on about which there is something new.

    Attributes:
        count: Number of valid records so far.
    """

    def __init__(self) -> None:
        """Start without records."""
        self.count = 0
        self._columns = np.empty((1 + len(Records._fields), 0), np.int64)
        self._found, self._sorted, self._reach = NOTHING, _NONE, _NONE
        self._late: Key | None = None  # the first number with rows that may come yet

    def add(self, records: Records, places: Index) -> None:
        """Add records, in the order of writing; those that no dataset has written are left out.

        Args:
            records: The records.
            places: Their rows in the table.
        """
        valid = records.is_valid
        if not valid.all():
            records, places = records.take(valid), places[valid]
        total = self.count + len(places)
        if total > self._columns.shape[1]:
            grown = np.empty((len(self._columns), max(_SOME, total + self.count)), np.int64)
            grown[:, : self.count] = self._columns[:, : self.count]
            self._columns = grown
        for known, new in zip(self._columns, (places, *records), strict=True):
            known[self.count : total] = new
        self.count = total

    @property
    def records(self) -> Records:
        """The records, in the order of writing."""
        return Records(*self._columns[1:, : self.count])

    @property
    def places(self) -> Index:
        """Their rows in the table, shape (records,)."""
        return self._columns[0, : self.count]

    def find(self, addresses: Addresses) -> Found:
        """Return the episodes that count.

        Args:
            addresses: Where the rows are now: those that there were before still are there.

        Raises:
            ValueError: If episodes share rows.
        """
        records, new = self.records, np.arange(len(self._sorted), self.count)
        keys = [self._first(records, new)] if len(new) else []
        keys += [self._late] if self._late is not None else []
        if not keys:
            return self._found
        known = self._begin(records, min(keys))
        again = np.concatenate((self._sorted[known:], new))
        again = again[np.lexsort((again, records.episode[again], records.campaign[again]))]
        some = records.take(again)
        found = self._found.head(self._episodes_before(some))
        found = found.joined(resolve(some, addresses, again))
        check_shared(found, addresses)
        self._found, self._late = found, self._first_late(some, addresses)
        self._sorted = np.concatenate((self._sorted[:known], again))
        furthest = reach(some.campaign, some.episode + some.numbers)
        self._reach = np.concatenate((self._reach[:known], furthest))
        return found

    def _first(self, records: Records, which: Index) -> Key:
        """Return campaign and number of the first one of some records."""
        campaign = records.campaign[which]
        first = campaign.min()
        return int(first), int(records.episode[which][campaign == first].min())

    def _begin(self, records: Records, key: Key) -> int:
        """Return how many records, in order, have nothing to do with a number and those after."""
        sorted_campaigns = _View(records.campaign, self._sorted)
        begin = sorted_campaigns.before(key[0])
        end = sorted_campaigns.before(key[0] + 1)
        episode, number = _View(records.episode, self._sorted), key[1]
        known = episode.before(number, begin, end)
        while known > begin and self._reach[known - 1] > number:
            known = begin + int(self._reach[begin:known].searchsorted(number, "right"))
            number = int(records.episode[self._sorted[known]])
            known = episode.before(number, begin, known + 1)
        return known

    def _episodes_before(self, some: Records) -> int:
        """Return how many of the found episodes come before some records, in order."""
        campaign, episode = self._found.campaign, self._found.episode
        begin, end = campaign.searchsorted([some.campaign[0], some.campaign[0] + 1])
        return int(begin + episode[begin:end].searchsorted(some.episode[0]))

    def _first_late(self, some: Records, addresses: Addresses) -> Key | None:
        late = np.flatnonzero(some.first_row + some.rows > addresses.end)
        return self._first(some, late[:1]) if len(late) else None


class _View:
    """A sorted column, seen through the numbers of its entries in order."""

    def __init__(self, column: Index, order: Index) -> None:
        self._column, self._order = column, order

    def before(self, value: int, begin: int = 0, end: int | None = None) -> int:
        """Return the place of the first entry from `value` on."""
        end = len(self._order) if end is None else end
        while begin < end:
            middle = (begin + end) // 2
            if self._column[self._order[middle]] < value:
                begin = middle + 1
            else:
                end = middle
        return begin
