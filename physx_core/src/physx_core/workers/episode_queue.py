"""EpisodeQueue: the numbers of a campaign's episodes that nobody has simulated yet."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Collection

from physx_core.dataset import EpisodeRecord, EpisodeStatus


class EpisodeQueue:
    """Gives out each number once; one whose simulation was lost is given out again, and first.

    Attributes:
        total: Number of episodes of the campaign: those from 0 to ``total - 1``.
        finished: How many of them are recorded, in this run or before.
    """

    def __init__(self, total: int, recorded: Collection[int] = (), retries: int = 1) -> None:
        """Start with all numbers that are not recorded.

        Args:
            total: Number of episodes.
            recorded: Numbers that an earlier run has recorded; those from `total` on are ignored.
            retries: How often a number is given out again after it was lost.
        """
        self.total = total
        self._recorded = {number for number in recorded if number < total}
        self.finished = len(self._recorded)
        self._retries = retries
        self._losses: Counter[int] = Counter()
        self._returned: list[int] = []
        self._next = 0

    @property
    def is_done(self) -> bool:
        """Whether every number is recorded."""
        return self.finished == self.total

    def take(self) -> int | None:
        """Return the next number; None if none waits, though one may be lost and returned yet."""
        if self._returned:
            return heapq.heappop(self._returned)
        while self._next < self.total:
            number, self._next = self._next, self._next + 1
            if number not in self._recorded:
                return number
        return None

    def note(self, record: EpisodeRecord) -> None:
        """Note what became of a number, or of several."""
        if record.status is not EpisodeStatus.MORE:
            self.finished += record.count

    def take_range(self, most: int) -> range:
        """Return the next numbers that follow one another, at most so many; empty if none waits."""
        is_new, first = not self._returned, self.take()
        if first is None:
            return range(0)
        if not is_new:
            return range(first, first + 1)
        end = min(first + most, self.total)
        self._next = next(filter(self._recorded.__contains__, range(first + 1, end)), end)
        return range(first, self._next)

    @property
    def waiting(self) -> int:
        """How many numbers wait, at most."""
        return self.total - self._next + len(self._returned)

    def put_back(self, number: int) -> None:
        """Return a number that nobody has begun to simulate."""
        heapq.heappush(self._returned, number)

    def give_back(self, number: int) -> bool:
        """Return a number whose simulation was lost; False if that has happened too often."""
        self._losses[number] += 1
        if self._losses[number] > self._retries:
            return False
        heapq.heappush(self._returned, number)
        return True
