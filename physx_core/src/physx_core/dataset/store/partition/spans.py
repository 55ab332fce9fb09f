"""Spans: the rows of a mode that a partition has, and the flat index over all partitions."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from physx_core.typing import Index


class Span(NamedTuple):
    """The rows of a mode that a partition has: consecutive ones, or every n-th.

    Attributes:
        start: The first row.
        rows: Number of rows.
        stride: Distance between its rows: the number of partitions that take turns.
        place: Place of this partition among them.
    """

    start: int
    rows: int
    stride: int = 1
    place: int = 0

    def inside(self, start: int, stop: int) -> tuple[int, int]:
        """Return the first and the number of its rows among rows `start` to `stop` of the mode."""
        first = max(0, -((self.start - start) // self.stride))
        last = min(self.rows, -((self.start - stop) // self.stride))
        return first, max(0, last - first)

    def among(self, first: int, count: int, start: int) -> slice:
        """Return the places of `count` of its rows, from `first` on, relative to row `start`."""
        begin = self.start + first * self.stride - start
        return slice(begin, begin + max(0, count - 1) * self.stride + (count > 0), self.stride)


class FlatIndex:
    """Finds the partition of a row and its place there.

    Attributes:
        strided: Whether partitions take turns anywhere.
    """

    def __init__(self, spans: Sequence[Span]) -> None:
        """Take the spans of a mode's partitions in order; empty ones may be left out."""
        first = [number for number, span in enumerate(spans) if span.rows and not span.place]
        self.strided = any(span.stride > 1 for span in spans)
        self._spans = spans
        self._runs = [spans[number].start for number in first]
        self._first = first
        self._starts = np.array(self._runs, np.intp)
        self._numbers = np.array(first, np.intp)
        self._strides = np.array([spans[number].stride for number in first], np.intp)

    def locate(self, rows: Index) -> tuple[Index, Index]:
        """Return the number of each row's partition and the row's number there."""
        runs = self._starts.searchsorted(rows, "right") - 1
        places = rows - self._starts[runs]
        if not self.strided:
            return self._numbers[runs], places
        places, turns = np.divmod(places, self._strides[runs])
        return self._numbers[runs] + turns, places

    def find(self, row: int) -> tuple[int, int, int]:
        """Return a row's partition, its number there, and how many consecutive rows start there."""
        run = bisect_right(self._runs, row) - 1
        span = self._spans[self._first[run]]
        place, turn = divmod(row - span.start, span.stride)
        number = self._first[run] + turn
        return number, place, span.rows - place if span.stride == 1 else 1
