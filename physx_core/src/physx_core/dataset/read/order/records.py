"""Finds which records of the table of episodes count, and where the rows of their episodes are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.store.episode_table import OPEN, EpisodeStatus
from physx_core.typing import Index

Flags = NDArray[np.bool_]

_HIGHEST = max(EpisodeStatus)


class Records(NamedTuple):
    """Columns of the table about one mode, in the order of writing, each of shape (records,)."""

    campaign: Index
    episode: Index
    numbers: Index
    first_row: Index
    rows: Index
    part: Index
    status: Index

    def take(self, index: Index | Flags) -> Records:
        """Return some of the records."""
        return Records(*(column[index] for column in self))

    @property
    def is_valid(self) -> Flags:
        """Which records the dataset may have written: the table may come from elsewhere."""
        valid = np.ones(len(self.rows), bool)
        for column in self:
            valid &= (column >= -1) & (column <= OPEN)
        stream = self.status == EpisodeStatus.STREAM
        several = (self.status == EpisodeStatus.FINISHED) & (self.rows == self.numbers)
        valid &= (self.campaign >= 0) & (np.minimum(self.first_row, self.rows) >= 0)
        valid &= (self.status >= 0) & (self.status <= _HIGHEST)
        valid &= np.where(stream, self.episode == -1, self.episode >= 0)
        valid &= (self.numbers == 1) | (several & (self.numbers > 1) & (self.part == 0))
        return valid


class RecordedEpisodes(NamedTuple):
    """RecordedEpisodes that count, in order of campaign and number; arrays of shape (episodes,).

    Attributes:
        campaign: Number of the campaign.
        episode: Number of the (first) episode; -1 for a stream.
        numbers: For how many numbers, of one row each, the entry stands.
        status: An `EpisodeStatus`, not ``MORE``.
        first: The first of its rows in the mode.
        rows: Number of its rows, 0 for a failed one.
    """

    campaign: Index
    episode: Index
    numbers: Index
    status: Index
    first: Index
    rows: Index


class Places(NamedTuple):
    """Where the rows that count are stored: pieces, in order, each of consecutive rows.

    Attributes:
        first: The first stored row of each piece, shape (pieces,).
        rows: Number of rows of each piece, shape (pieces,).
    """

    first: Index
    rows: Index


class _Chosen(NamedTuple):
    """Complete episodes.

    Attributes:
        records: Records in order of campaign and number, with rows as they are stored now.
        start: The record of each episode's part 0, shape (episodes,).
        parts: Number of its parts.
        offset: Which row of the record is the episode's, if only one is.
        numbers: For how many numbers it stands.
    """

    records: Records
    start: Index
    parts: Index
    offset: Index
    numbers: Index

    @property
    def campaign(self) -> Index:
        """Number of each episode's campaign."""
        return self.records.campaign[self.start]

    @property
    def episode(self) -> Index:
        """Number of each episode in it."""
        found: Index = self.records.episode[self.start] + self.offset
        return found

    @property
    def status(self) -> Index:
        """How each episode ended."""
        found: Index = self.records.status[self.start + self.parts - 1]
        return found

    def take(self, index: Index | slice) -> _Chosen:
        """Return some of the episodes."""
        return _Chosen(self.records, *(column[index] for column in self[1:]))


def resolve(
    table: Records, addresses: Addresses, seen: int | None = None
) -> tuple[RecordedEpisodes, Places]:
    """Return the episodes that count, in order, and where their rows are.

    Args:
        table: The valid records about the mode.
        addresses: Where the rows of the mode are.
        seen: If only the episodes before the first missing number count: how many records count
            regardless, since they were read when all did. None: all episodes count.

    Raises:
        ValueError: If episodes share rows.
    """
    order = np.lexsort((table.episode, table.campaign))
    wanted = table.take(order)
    first = addresses.stored_before(wanted.first_row)
    rows = addresses.stored_before(wanted.first_row + wanted.rows) - first
    stream, failed = (wanted.status == s for s in (EpisodeStatus.STREAM, EpisodeStatus.FAILED))
    chosen = _newest_complete(
        wanted._replace(first_row=first, rows=rows),
        stream | failed | (rows == wanted.rows),
    )
    _, places = _places(chosen)
    if places.rows.sum() > addresses.rows:
        raise ValueError("episodes share rows")
    chosen = _without_replaced(chosen, order)
    if seen is not None:
        known = order[chosen.start + chosen.parts - 1] < seen
        known[: _first_gap(chosen)] = True
        chosen = chosen.take(np.flatnonzero(known))
    ends, places = _places(chosen)
    rows = np.diff(np.cumsum(places.rows)[ends], prepend=0)
    return _describe(chosen, rows), _joined(places)


def _newest_complete(records: Records, whole: Flags) -> _Chosen:
    """Return the newest complete episode of each number, and all complete ranges of numbers.

    Args:
        records: The records in order of campaign and number, then as written.
        whole: Which of them have all their rows.
    """
    total = len(whole)
    new = np.diff(records.campaign, prepend=-1) != 0
    new |= np.diff(records.episode, prepend=-2) != 0
    start = np.flatnonzero(new | (records.part == 0))
    parts = np.diff(start, append=total)
    is_last = np.zeros(total, bool)
    is_last[start + parts - 1] = True
    fine = whole & (records.part == np.arange(total) - np.repeat(start, parts))
    fine &= (records.status != EpisodeStatus.MORE) == is_last
    complete = np.logical_and.reduceat(fine, start) if total else np.zeros(0, bool)
    start, parts = start[complete], parts[complete]
    newest = np.diff(np.cumsum(new)[start], append=-1) != 0
    newest |= records.numbers[start] > 1  # its other numbers may not have been replaced
    start, parts = start[newest], parts[newest]
    return _Chosen(records, start, parts, np.zeros_like(start), records.numbers[start])


def _without_replaced(chosen: _Chosen, order: Index) -> _Chosen:
    """Take apart ranges of numbers of which some were recorded again; keep the newest of each.

    Args:
        chosen: The episodes.
        order: Number of each record in the order of writing.
    """
    campaign, end = chosen.campaign, chosen.episode + chosen.numbers
    if not ((np.diff(campaign) == 0) & (end[:-1] > chosen.episode[1:])).any():
        return chosen
    each = np.repeat(np.arange(len(end)), chosen.numbers)
    starts = np.cumsum(chosen.numbers) - chosen.numbers
    single = chosen.take(each)._replace(
        offset=np.arange(len(each)) - starts[each], numbers=np.ones_like(each)
    )
    written = order[single.start + single.parts - 1]
    place = np.lexsort((written, single.episode, single.campaign))
    single = single.take(place)
    same = (np.diff(single.campaign) == 0) & (np.diff(single.episode) == 0)
    return single.take(np.flatnonzero(np.append(~same, True)))


def _first_gap(chosen: _Chosen) -> int:
    """Return the number of episodes before the first one whose predecessor is missing."""
    expected = np.zeros(len(chosen.start), np.int64)
    expected[1:] = (chosen.episode + chosen.numbers)[:-1]
    expected[1:][np.diff(chosen.campaign) != 0] = 0
    gaps = np.flatnonzero(chosen.episode > expected)
    return int(gaps[0]) if len(gaps) else len(expected)


def _places(chosen: _Chosen) -> tuple[Index, Places]:
    """Return which piece is the last of each episode, and the pieces of all episodes."""
    ends = np.cumsum(chosen.parts)
    shift = np.repeat(chosen.start - (ends - chosen.parts), chosen.parts)
    record = np.arange(len(shift)) + shift
    first = chosen.records.first_row[record] + np.repeat(chosen.offset, chosen.parts)
    alone = np.repeat(chosen.numbers == 1, chosen.parts) & (chosen.records.numbers[record] > 1)
    rows = np.where(alone, 1, chosen.records.rows[record])
    rows[np.repeat(chosen.status == EpisodeStatus.FAILED, chosen.parts)] = 0
    return ends - 1, Places(first, rows)


def _describe(chosen: _Chosen, rows: Index) -> RecordedEpisodes:
    status, first = chosen.status, np.cumsum(rows) - rows
    return RecordedEpisodes(chosen.campaign, chosen.episode, chosen.numbers, status, first, rows)


def _joined(places: Places) -> Places:
    """Return pieces, with those joined that follow one another where they are stored."""
    first, rows = (column[places.rows > 0] for column in places)
    new = np.ones(len(first), bool)
    new[1:] = first[1:] != first[:-1] + rows[:-1]
    begins = np.flatnonzero(new)
    return Places(first[begins], np.add.reduceat(rows, begins) if len(rows) else rows)
