"""EpisodeQueue: the numbers of a campaign's episodes that nobody has simulated yet."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection, Mapping

import numpy as np

from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.typing import Index
from physx_core.workers.lease import Begun, EpisodeState


class EpisodeQueue:
    """Gives out each number once; one whose simulation was lost is given out again, and first.

    Attributes:
        total: Number of episodes of the campaign: those from 0 to ``total - 1``.
        end: Numbers from here on are not given out yet.
        finished: How many of them are recorded, in this run or before.
    """

    def __init__(
        self,
        total: int,
        recorded: Collection[int] | Index = (),
        retries: int | None = None,
        begun: Mapping[int, Begun] | None = None,
    ) -> None:
        """Start with all numbers that are not recorded.

        Args:
            total: Number of episodes.
            recorded: Numbers that an earlier run has recorded; those from `total` on are ignored.
            retries: How often a number is given out again after it was lost; None: once.
            begun: What an earlier run has stored of episodes that are not recorded.
        """
        self.total = self.end = total
        known = recorded if isinstance(recorded, np.ndarray) else np.array([*recorded], np.int64)
        numbers = np.sort(known, kind="stable")
        numbers = numbers[(numbers < total) & (np.diff(numbers, prepend=-1) > 0)]
        self.finished = len(numbers)
        self._begun = {number: each for number, each in (begun or {}).items() if number < total}
        self._begins, self._ends = _gaps(numbers, total, self._begun)
        self._losses, self._retries = Counter[int](), 1 if retries is None else retries
        self._returned: list[int] = []
        self._gap, self._next = 0, 0

    @property
    def is_done(self) -> bool:
        """Whether every number is recorded."""
        return self.finished == self.total

    def take(self) -> int | None:
        """Return the next number; None if none waits, though one may be lost and returned yet."""
        return next(iter(self.take_range(1)), None)

    def take_range(self, most: int) -> range:
        """Return the next numbers that follow one another, at most so many; empty if none waits."""
        if self._returned:
            number = heapq.heappop(self._returned)
            return range(number, number + 1)
        if self._gap == len(self._begins):
            return range(0)
        first, end = self._first, int(self._ends[self._gap])
        numbers = range(first, min(first + most, end, self.end))
        if numbers:
            self._next = numbers.stop
            self._gap += self._next == end
        return numbers

    @property
    def _first(self) -> int:
        """The first number that was never given out; there must be one."""
        return max(self._next, int(self._begins[self._gap]))

    def needs(self, number: int) -> bool:
        """Return whether a number that has ended is known to be needed."""
        return number < self.total

    def note(self, record: EpisodeRecord) -> None:
        """Note what became of a number, or of several."""
        if record.status is not EpisodeStatus.MORE:
            self.finished += record.count

    def follow(self, record: EpisodeRecord, state: EpisodeState | None = None) -> None:
        """Note what there is of a number that has not ended, for whoever goes on with it.

        Args:
            record: What has come from its client.
            state: Its newest state; None: as before.

        Raises:
            ValueError: If the state is of another one, or after rows that have not come.
        """
        before = self._begun.pop(record.episode, None) if self._begun else None
        if record.status is not EpisodeStatus.MORE:
            return
        if before is None or not record.part:
            before = Begun(0, 0)
        begun = before._replace(part=record.part + 1, rows=before.rows + record.rows)
        if state is not None:
            if state.episode != record.episode or not 0 < state.made <= begun.rows:
                raise ValueError("a state of another episode, or after rows that it has not sent")
            begun = begun._replace(made=state.made, state=state.state)
        self._begun[record.episode] = begun

    def begun(self, number: int) -> Begun | None:
        """Return from where a number goes on; None: it begins."""
        found = self._begun.get(number)
        return found if found is not None and found.state else None

    @property
    def waiting(self) -> int:
        """How many numbers wait, at most."""
        return self.total - self._next + len(self._returned)

    def put_back(self, number: int) -> None:
        """Return a number that nobody has begun to simulate."""
        heapq.heappush(self._returned, number)

    def give_back(self, number: int) -> bool:
        """Return a number whose simulation was lost; False if that has happened too often."""
        if self._losses[number] >= self._retries:
            return False
        self._losses[number] += 1
        heapq.heappush(self._returned, number)
        return True


def _gaps(numbers: Index, total: int, alone: Collection[int]) -> tuple[Index, Index]:
    """Return the begins and ends of the ranges of numbers below `total` that are missing.

    Args:
        numbers: The numbers that are there, in order.
        total: See above.
        alone: Missing ones that are ranges of their own.
    """
    begins, ends = np.append(0, numbers + 1), np.append(numbers, total)
    missing = begins < ends
    begins, ends = begins[missing], ends[missing]
    single = np.array(sorted(alone), np.int64)
    more_begins = np.union1d(single, np.setdiff1d(single + 1, ends))
    more_ends = np.union1d(single + 1, np.setdiff1d(single, begins))
    return np.union1d(begins, more_begins), np.union1d(ends, more_ends)
