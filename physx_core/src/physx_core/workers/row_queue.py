"""RowQueue: as many episodes of a campaign as a number of rows needs."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection
from itertools import chain

import numpy as np

from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import UsageError
from physx_core.workers.episode_queue import EpisodeQueue

_NO_END = 2**47
_MOST_EMPTY = 1000


class RowQueue(EpisodeQueue):
    """Gives out numbers until those without a gap have enough rows.

    How many an episode will have is unknown before it ends: as many numbers are being simulated as
    are needed if each has the mean number of rows. The last ones may turn out to be surplus.

    Attributes:
        goal: How many rows are wanted.
        rows: How many the episodes before the first missing number have.
        missing: The first missing number.
        choose: Chooses parameters of numbers below another one; returns the first number without.
            None: all can be chosen at any time.
    """

    choose: Callable[[RowQueue, int], int] | None = None

    def __init__(
        self, goal: int, recorded: Collection[EpisodeRecord] = (), retries: int = 1
    ) -> None:
        """Start with the numbers that are not recorded.

        Args:
            goal: How many rows are wanted.
            recorded: Numbers that an earlier run has recorded.
            retries: How often a number is given out again after it was lost.
        """
        ranges = (range(each.episode, each.episode + each.count) for each in recorded)
        numbers = np.array([*chain.from_iterable(ranges)], np.int64)
        super().__init__(_NO_END, numbers, retries)
        self.goal, self.rows = goal, 0
        self._taken = self._all_rows = 0
        self._parts: Counter[int] = Counter()  # number to its rows so far
        self._ended: dict[int, tuple[int, int]] = {}  # first number to how many, and their rows
        self.missing = 0
        self._firsts, self._sums = [0], [0]  # numbers up to the first missing one, rows before them
        self._last = -1  # the last one that has ended
        for each in recorded:
            self._end(each.episode, each.count, each.rows)

    @property
    def is_done(self) -> bool:
        """Whether the episodes before the first missing number have enough rows."""
        return self.rows >= self.goal

    @property
    def waiting(self) -> int:
        """How many numbers wait, about."""
        return max(0, round((self.goal - self._expected) / self._mean))

    def take_range(self, most: int) -> range:
        """Return the next numbers; none if those that are being simulated may be enough."""
        fills_gap = self._returned or self._next <= self._last
        if not fills_gap and self._expected >= self.goal:
            return range(0)
        most = min(most, max(1, self.waiting))
        if self.choose is not None:
            self.end = self.choose(self, self._first + most)
        found = super().take_range(most)
        self._taken += len(found)
        return found

    def note(self, record: EpisodeRecord) -> None:
        """Note what became of a number, or of several.

        Raises:
            UsageError: If no episode has a row.
        """
        super().note(record)
        if record.part == 0:
            self._parts.pop(record.episode, None)
        if record.status is EpisodeStatus.MORE:
            self._parts[record.episode] += record.rows
            return
        self._taken -= record.count
        rows = self._parts.pop(record.episode, 0) + record.rows
        self._end(record.episode, record.count, rows)
        if self.missing >= _MOST_EMPTY and not self.rows:
            raise UsageError(
                f"{_MOST_EMPTY} episodes have no row, so there would never be {self.goal} rows: "
                "call set_training_data() in the step that calls end_episode()."
            )

    def needs(self, number: int) -> bool:
        """Return whether a number is known to be needed: those before it have too few rows."""
        return number < self.missing and self.rows_before(number) < self.goal

    def rows_before(self, number: int) -> int:
        """Return how many rows the episodes before a number have, of those that have ended."""
        place = bisect_right(self._firsts, max(0, number)) - 1
        return self._sums[place] + max(0, number) - self._firsts[place]  # one row each, if several

    def put_back(self, number: int) -> None:
        """Return a number that nobody has begun to simulate."""
        super().put_back(number)
        self._taken -= 1

    def give_back(self, number: int) -> bool:
        """Return a number whose simulation was lost; False if that has happened too often."""
        returned = super().give_back(number)
        self._taken -= returned
        return returned

    @property
    def _mean(self) -> float:
        """Rows of an episode, at least 1."""
        return max(1.0, self._all_rows / max(1, self.finished))

    @property
    def _expected(self) -> float:
        return self._all_rows + self._taken * self._mean

    def _end(self, first: int, count: int, rows: int) -> None:
        self._all_rows += rows
        self._ended[first] = count, rows
        self._last = max(self._last, first + count - 1)
        while self.missing in self._ended:
            count, rows = self._ended.pop(self.missing)
            self.missing += count
            self.rows += rows
            self._firsts.append(self.missing)
            self._sums.append(self.rows)
