"""Finds which records of the table of episodes count, and where the rows of their episodes are."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.store.episode_record import OPEN, EpisodeStatus
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

    def take(self, index: Index | Flags | slice) -> Records:
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


class Found(NamedTuple):
    """Episodes that count, in order of campaign and number, and their parts, in order.

    Attributes:
        campaign, episode, numbers, status: As in `RecordedEpisodes`, shape (episodes,).
        parts: Number of parts of each episode, shape (episodes,).
        record: Number of the record of each part, in the order of writing, shape (parts,).
        first: Its first stored row.
        rows: Its number of rows.
    """

    campaign: Index
    episode: Index
    numbers: Index
    status: Index
    parts: Index
    record: Index
    first: Index
    rows: Index

    def head(self, episodes: int) -> Found:
        """Return the first episodes."""
        parts = int(self.parts[:episodes].sum())
        return Found(*(c[:episodes] for c in self[:5]), *(c[:parts] for c in self[5:]))

    def take(self, chosen: Flags) -> Found:
        """Return some of the episodes."""
        parts = np.repeat(chosen, self.parts)
        return Found(*(c[chosen] for c in self[:5]), *(c[parts] for c in self[5:]))

    def joined(self, further: Found) -> Found:
        """Return these episodes and further ones, which come after them."""
        if not len(self.campaign):
            return further
        return Found(*map(np.concatenate, zip(self, further, strict=True)))

    @property
    def last(self) -> Index:
        """Number of the last record of each episode."""
        found: Index = self.record[np.cumsum(self.parts) - 1]
        return found

    @property
    def episodes(self) -> RecordedEpisodes:
        """The episodes with their rows."""
        rows = np.diff(np.cumsum(self.rows)[np.cumsum(self.parts) - 1], prepend=0)
        first = np.cumsum(rows) - rows
        return RecordedEpisodes(*self[:4], first, rows)

    @property
    def places(self) -> Places:
        """Where their rows are: pieces that follow one another where they are stored are joined."""
        first, rows = (column[self.rows > 0] for column in (self.first, self.rows))
        new = np.ones(len(first), bool)
        new[1:] = first[1:] != first[:-1] + rows[:-1]
        begins = np.flatnonzero(new)
        return Places(first[begins], np.add.reduceat(rows, begins) if len(rows) else rows)

    @property
    def before_gap(self) -> int:
        """Number of episodes before the first one whose predecessor is missing."""
        expected = np.zeros(len(self.campaign), np.int64)
        expected[1:] = (self.episode + self.numbers)[:-1]
        expected[1:][np.diff(self.campaign) != 0] = 0
        gaps = np.flatnonzero(self.episode > expected)
        return int(gaps[0]) if len(gaps) else len(expected)


NO_RECORDS = Records(*(np.zeros(0, np.int64) for _ in Records._fields))
NOTHING = Found(*(np.zeros(0, np.int64) for _ in Found._fields))


class _Chosen(NamedTuple):
    """Complete episodes.

    Attributes:
        records: Records in order of campaign and number, with rows as they are stored now.
        start: The record of each episode's part 0, shape (episodes,).
        parts: Number of its parts.
        offset: Which row of the record is the first of its own, if it has not all.
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

    def take(self, index: Index | Flags) -> _Chosen:
        """Return some of the episodes."""
        return _Chosen(self.records, *(column[index] for column in self[1:]))


def resolve(records: Records, addresses: Addresses, written: Index) -> Found:
    """Return the episodes that count, in order, and where their rows are.

    Args:
        records: Valid records about the mode, all that there are about the numbers that they are
            about, in order of campaign and number, then as written.
        addresses: Where the rows of the mode are.
        written: Number of each record in the order of writing, shape (records,).

    Raises:
        ValueError: If episodes share rows.
    """
    first = addresses.stored_before(records.first_row)
    rows = addresses.stored_before(records.first_row + records.rows) - first
    stream, failed = (records.status == s for s in (EpisodeStatus.STREAM, EpisodeStatus.FAILED))
    chosen = _newest_complete(
        records._replace(first_row=first, rows=rows),
        stream | failed | (rows == records.rows),
    )
    found = _found(chosen, written)
    check_shared(found, addresses)
    kept = _without_replaced(chosen, written)
    return found if kept is chosen else _found(kept, written)


def check_shared(found: Found, addresses: Addresses) -> None:
    """Check that episodes have no more rows than there are.

    Raises:
        ValueError: If they have.
    """
    if found.rows.sum() > addresses.rows:
        raise ValueError("episodes share rows")


def reach(campaign: Index, end: Index) -> Index:
    """Return the greatest number before which each record or one before it ends, in its campaign.

    Args:
        campaign: The campaigns, in order.
        end: The number after the last one of each record.
    """
    found = np.empty(len(end), np.int64)
    bounds = [*np.flatnonzero(np.diff(campaign, prepend=-1)).tolist(), len(end)]
    for begin, stop in itertools.pairwise(bounds):
        np.maximum.accumulate(end[begin:stop], out=found[begin:stop])
    return found


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


def _without_replaced(chosen: _Chosen, written: Index) -> _Chosen:
    """Leave out numbers of ranges that were recorded again later: keep the newest of each.

    Args:
        chosen: The episodes.
        written: Number of each record in the order of writing.
    """
    campaign, episode = chosen.campaign, chosen.episode
    furthest = reach(campaign, episode + chosen.numbers)
    begins = np.diff(campaign, prepend=-1) != 0
    begins[1:] |= episode[1:] >= furthest[:-1]
    group = np.cumsum(begins) - 1
    crowded = np.bincount(group)[group] > 1 if len(group) else begins
    if not crowded.any():
        return chosen
    single = _newest_of_each(_apart(chosen.take(crowded)), written)
    kept = chosen.take(~crowded)
    both = _Chosen(chosen.records, *map(np.concatenate, zip(kept[1:], single[1:], strict=True)))
    return both.take(np.lexsort((both.episode, both.campaign)))


def _apart(chosen: _Chosen) -> _Chosen:
    """Return an episode for each number of ranges."""
    each = np.repeat(np.arange(len(chosen.start)), chosen.numbers)
    starts = np.cumsum(chosen.numbers) - chosen.numbers
    offset = chosen.offset[each] + np.arange(len(each)) - starts[each]
    return chosen.take(each)._replace(offset=offset, numbers=np.ones_like(each))


def _newest_of_each(single: _Chosen, written: Index) -> _Chosen:
    """Return the newest episode of each number; those of a range that follow one another as one."""
    last = written[single.start + single.parts - 1]
    single = single.take(np.lexsort((last, single.episode, single.campaign)))
    same = (np.diff(single.campaign) == 0) & (np.diff(single.episode) == 0)
    single = single.take(np.append(~same, True))
    begins = np.diff(single.start, prepend=-1) != 0
    begins[1:] |= np.diff(single.episode) != 1
    runs = np.flatnonzero(begins)
    return single.take(runs)._replace(numbers=np.diff(runs, append=len(begins)))


def _found(chosen: _Chosen, written: Index) -> Found:
    """Return the episodes with the places of their parts."""
    ends = np.cumsum(chosen.parts)
    shift = np.repeat(chosen.start - (ends - chosen.parts), chosen.parts)
    record = np.arange(len(shift)) + shift
    status = chosen.records.status[chosen.start + chosen.parts - 1]
    first = chosen.records.first_row[record] + np.repeat(chosen.offset, chosen.parts)
    is_range = chosen.records.numbers[record] > 1
    rows = np.where(is_range, np.repeat(chosen.numbers, chosen.parts), chosen.records.rows[record])
    rows[np.repeat(status == EpisodeStatus.FAILED, chosen.parts)] = 0
    numbers = chosen.campaign, chosen.episode, chosen.numbers
    return Found(*numbers, status, chosen.parts, written[record], first, rows)
