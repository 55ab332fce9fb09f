"""Spans: which rows of a mode a partition has, and the flat index over all of them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from physx_core.typing import Index


class Span(NamedTuple):
    """Which rows of a mode a partition has: consecutive ones, or every n-th.

    Attributes:
        start: The first one.
        rows: How many.
        stride: Distance from each to the next: how many partitions take turns.
        place: Place of this one among them.
    """

    start: int
    rows: int
    stride: int = 1
    place: int = 0

    def inside(self, start: int, stop: int) -> tuple[int, int]:
        """Return which of its rows are rows `start` to `stop` of the mode: the first, how many."""
        first = max(0, -((self.start - start) // self.stride))
        last = min(self.rows, -((self.start - stop) // self.stride))
        return first, max(0, last - first)

    def among(self, first: int, count: int, start: int) -> slice:
        """Return where `count` of its rows, from `first` on, lie behind row `start` of the mode."""
        begin = self.start + first * self.stride - start
        return slice(begin, begin + max(0, count - 1) * self.stride + (count > 0), self.stride)


class FlatIndex:
    """Finds the partition of a row, and its place there.

    Attributes:
        strided: Whether partitions take turns anywhere.
    """

    def __init__(self, spans: Sequence[Span]) -> None:
        """Take the spans of a mode's partitions, in their order; empty ones may be left out."""
        first = [number for number, span in enumerate(spans) if span.rows and not span.place]
        self.strided = any(span.stride > 1 for span in spans)
        self._spans = spans
        self._runs = [spans[number].start for number in first]
        self._first = first
        self._starts = np.array(self._runs, np.intp)
        self._numbers = np.array(first, np.intp)
        self._strides = np.array([spans[number].stride for number in first], np.intp)

    def locate(self, rows: Index) -> tuple[Index, Index]:
        """Return the number of each row's partition, and the row there."""
        runs = self._starts.searchsorted(rows, "right") - 1
        places = rows - self._starts[runs]
        if not self.strided:
            return self._numbers[runs], places
        places, turns = np.divmod(places, self._strides[runs])
        return self._numbers[runs] + turns, places

    def find(self, row: int) -> tuple[int, int, int]:
        """Return a row's partition, the row there, and how many rows of the mode follow there."""
        run = bisect_right(self._runs, row) - 1
        span = self._spans[self._first[run]]
        place, turn = divmod(row - span.start, span.stride)
        number = self._first[run] + turn
        return number, place, span.rows - place if span.stride == 1 else 1
