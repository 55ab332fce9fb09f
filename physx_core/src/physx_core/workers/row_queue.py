"""RowQueue: as many episodes of a campaign as a number of rows needs."""

from __future__ import annotations

import warnings
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from physx_core.dataset import EpisodeRecord, EpisodeStatus
from physx_core.errors import UsageError
from physx_core.typing import Index
from physx_core.workers.episode_queue import EpisodeQueue
from physx_core.workers.lease import Begun

_NO_END = 2**47
_SOME_EMPTY, _MOST_EMPTY = 1000, 10_000


class Ended(NamedTuple):
    """Episodes that have ended, in order of their numbers; arrays of shape (entries,).

    Attributes:
        first: The (first) number of each entry.
        numbers: For how many numbers it stands; if they are several, each has one row.
        rows: How many rows it has.
    """

    first: Index
    numbers: Index
    rows: Index

    @property
    def all_numbers(self) -> Index:
        """Each number, shape (episodes,)."""
        begins = np.repeat(self.first - np.cumsum(self.numbers) + self.numbers, self.numbers)
        found: Index = begins + np.arange(len(begins))
        return found


NONE_ENDED = Ended(*(np.zeros(0, np.int64) for _ in Ended._fields))


class RowQueue(EpisodeQueue):
    """Gives out numbers until those without a gap have enough rows.

    How many an episode will have is unknown before it ends: as many numbers are being simulated as
    are needed if each has the mean number of rows. The last ones may turn out to be surplus.

    Attributes:
        goal: How many rows are wanted.
        choose: Chooses parameters of numbers below another one; returns the first number without.
            None: all can be chosen at any time.
    """

    choose: Callable[[RowQueue, int], int] | None = None

    def __init__(
        self,
        goal: int,
        recorded: Ended = NONE_ENDED,
        retries: int | None = None,
        begun: Mapping[int, Begun] | None = None,
    ) -> None:
        """Start with the numbers that are not recorded.

        Args:
            goal: How many rows are wanted.
            recorded: Episodes that an earlier run has recorded.
            retries: How often a number is given out again after it was lost; None: once.
            begun: What it has stored of others.
        """
        super().__init__(_NO_END, recorded.all_numbers, retries, begun)
        first, numbers, rows = recorded
        ends = np.cumsum(numbers)
        before = int((first == ends - numbers).sum())  # entries before the first missing number
        later = zip(*(column[before:].tolist() for column in recorded), strict=True)
        self.goal, self._taken, self._all_rows = goal, 0, int(rows.sum())
        rows_so_far = {number: each.rows for number, each in self._begun.items()}
        self._parts = Counter[int](rows_so_far)  # by number
        self._ended = {first: (count, rows) for first, count, rows in later}  # after the missing
        self._last = int((first + numbers).max(initial=0)) - 1  # the last one that has ended
        # Numbers up to the first missing one, and the rows before them:
        self._firsts: list[int] = [0, *ends[:before].tolist()]
        self._sums: list[int] = [0, *np.cumsum(rows[:before]).tolist()]
        self._filled = int(ends[:before][rows[:before] > 0].max(initial=0))
        self._has_warned = False

    @property
    def missing(self) -> int:
        """The first missing number."""
        return self._firsts[-1]

    @property
    def rows(self) -> int:
        """How many rows the episodes before the first missing number have."""
        return self._sums[-1]

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
            UsageError: If no episode has a row, or too many in a row have none.
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
        self._check_empty()

    def _check_empty(self) -> None:
        """Check how many of the numbers before the first missing one have no row, at the end."""
        empty = self.missing - self._filled
        if empty < _SOME_EMPTY or self.is_done:
            return
        most = _MOST_EMPTY if self.rows else _SOME_EMPTY
        text = (
            f"The episodes {self._filled} to {self._filled + min(empty, most) - 1} have no row, "
            f"but {self.goal} rows are wanted and there are {self.rows}: call set_training_data() "
            "in each step, also in that which calls end_episode()."
        )
        if empty >= most:
            raise UsageError(text)
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(f"{text} The run ends after {_MOST_EMPTY} of them.", stacklevel=2)

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
            self._firsts.append(self.missing + count)
            self._sums.append(self.rows + rows)
            if rows:
                self._filled, self._has_warned = self.missing, False
