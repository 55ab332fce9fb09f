"""Spans: the rows of a mode that a partition has, and the flat index over all partitions."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from physx_core.typing import Index


class Span(NamedTuple):
    """The rows of a mode that a partition has.

    Attributes:
        start: The first row.
        rows: Number of rows.
    """

    start: int
    rows: int

    def inside(self, start: int, stop: int) -> tuple[int, int]:
        """Return the first and the number of its rows among rows `start` to `stop` of the mode."""
        first, last = max(0, start - self.start), min(self.rows, stop - self.start)
        return first, max(0, last - first)

    def among(self, first: int, count: int, start: int) -> slice:
        """Return the places of `count` of its rows, from `first` on, relative to row `start`."""
        begin = self.start + first - start
        return slice(begin, begin + count)


class FlatIndex:
    """Finds the partition of a row and its place there."""

    def __init__(self, spans: Sequence[Span]) -> None:
        """Take the spans of a mode's partitions in order; empty ones may be left out."""
        self._numbers = [number for number, span in enumerate(spans) if span.rows]
        self._starts = [spans[number].start for number in self._numbers]
        self._spans = spans
        self._numbers_array = np.array(self._numbers, np.intp)
        self._starts_array = np.array(self._starts, np.intp)

    def locate(self, rows: Index) -> tuple[Index, Index]:
        """Return the number of each row's partition and the row's number there."""
        runs = self._starts_array.searchsorted(rows, "right") - 1
        return self._numbers_array[runs], rows - self._starts_array[runs]

    def find(self, row: int) -> tuple[int, int, int]:
        """Return a row's partition, its number there, and how many rows of it start there."""
        run = bisect_right(self._starts, row) - 1
        number = self._numbers[run]
        place = row - self._starts[run]
        return number, place, self._spans[number].rows - place
