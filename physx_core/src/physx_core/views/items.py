"""Items: what a view learns from in one dataset: reference rows of windows, numbered from 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from physx_core.dataset import Trajectories
from physx_core.dataset.read.episodes import Flags
from physx_core.typing import Index
from physx_core.views.options import ViewOptions

_STEPS = 4


class Located(NamedTuple):
    """Some items, and where they are.

    Attributes:
        items: Their numbers, shape (items,).
        rows: Their reference rows, if the rows of a window follow one another there as its offsets
            do; None: they may not.
    """

    items: Index
    rows: Index | None

    def part(self, start: int, stop: int) -> Located:
        """Return some of them."""
        return Located(self.items[start:stop], None if self.rows is None else self.rows[start:stop])


class Items:
    """The windows in some trajectories; finding one takes no memory for the others.

    Attributes:
        count: Number of items.
        trajectory: Number of items of each trajectory, shape (trajectories,).
        is_plain: Whether item k is row k of the mode.
    """

    def __init__(self, view: ViewOptions, found: Trajectories) -> None:
        """Count the windows.

        Args:
            view: Defines them.
            found: The trajectories.
        """
        offsets = [offset for window in view.windows.values() for offset in window.at] or [0]
        low, high = min(0, *offsets), max(0, *offsets)
        self._pads = view.edges == "pad"
        if self._pads:
            low = high = 0
        is_single = low == high == 0 and not view.windows
        if is_single and view.stride == 1 and found.places is None and not view.weights:
            found = _joined(found)
        self._stride, self._low, self._found = view.stride, low, found
        room = np.maximum(0, found.rows - (high - low))
        self.trajectory: Index = -(-room // view.stride)
        self._ends = np.cumsum(self.trajectory)
        begins = self._ends - self.trajectory
        self._first = found.start - begins * view.stride - low  # row of item 0, were it in there
        self.count = int(self._ends[-1]) if len(self._ends) else 0
        self._cells = _Cells(self._ends, self.count)
        self.is_plain = (
            is_single
            and view.stride == 1
            and found.places is None
            and len(found.rows) == 1
            and int(found.start[0]) == 0
        )

    def rows(self, items: Index, offsets: Sequence[int] = (0,)) -> Index:
        """Return the row numbers of items at some offsets, shape (items, offsets)."""
        start, size, place = self._places(items)
        places = place[:, None] + np.asarray(offsets, np.intp)
        if self._pads:
            places = np.clip(places, 0, size[:, None] - 1)
        places += start[:, None]
        found = self._found.places
        return places if found is None else found[places]

    def locate(self, items: Index) -> Located:
        """Return items with their reference rows."""
        if self._pads or self._found.places is not None:
            return Located(items, None)
        rows = self._first.take(self.trajectories(items))
        rows += items if self._stride == 1 else items * self._stride
        return Located(items, rows)

    def are_padded(self, items: Index, offsets: Sequence[int]) -> Flags:
        """Return whether the values of items at some offsets are repeated, as `rows`."""
        _, size, place = self._places(items)
        places = place[:, None] + np.asarray(offsets, np.intp)
        return (places < 0) | (places >= size[:, None])

    def trajectories(self, items: Index) -> Index:
        """Return the place of the trajectory of each item, shape (items,)."""
        return self._cells.find(items)

    @property
    def num_rows(self) -> int:
        """Number of rows of the trajectories."""
        return int(self._found.rows.sum())

    def all_rows(self) -> Index:
        """Return the numbers of all rows of the trajectories, ascending."""
        found = self._found
        steps = np.repeat(found.start - np.cumsum(found.rows) + found.rows, found.rows)
        places = steps + np.arange(self.num_rows)
        return np.sort(places if found.places is None else found.places[places])

    def ranges(self) -> tuple[Index, Index]:
        """Return first rows, ascending, and numbers of rows of the ranges of rows in this part."""
        found = self._found
        if found.places is None:
            some = np.flatnonzero(found.rows)
            some = some[np.argsort(found.start[some])]
            return found.start[some], found.rows[some]
        rows = self.all_rows()
        begins = np.flatnonzero(np.diff(rows, prepend=-2) != 1)
        return rows[begins], np.diff(begins, append=len(rows))

    def _places(self, items: Index) -> tuple[Index, Index, Index]:
        """Return start and rows of each item's trajectory, and the place of its reference row."""
        which = self.trajectories(items)
        inside = items - (self._ends[which] - self.trajectory[which])
        return self._found.start[which], self._found.rows[which], inside * self._stride - self._low


def _joined(found: Trajectories) -> Trajectories:
    """Return trajectories that follow one another as one."""
    found = found.take(found.rows > 0)
    found = found.take(np.argsort(found.start))
    new = np.append(True, found.start[1:] != (found.start + found.rows)[:-1])[: len(found.start)]
    begins = np.flatnonzero(new)
    rows = np.add.reduceat(found.rows, begins) if len(begins) else found.rows
    return found.take(begins)._replace(rows=rows)


class _Cells:
    """Finds the trajectory of an item from a table by its first digits, quicker than by bisection.

    If in some places there are many short trajectories, it is by bisection after all.
    """

    def __init__(self, ends: Index, count: int) -> None:
        """Make the table.

        Args:
            ends: Number of items of each trajectory and those before it, shape (trajectories,).
            count: Number of items.
        """
        self._ends, self._shift = ends, max(0, (count // max(1, len(ends))).bit_length() - 1)
        size = count >> self._shift
        self._table = ends.searchsorted(np.arange(size + 2) << self._shift, "right")
        self._steps = int(np.diff(self._table).max(initial=0))

    def find(self, items: Index) -> Index:
        """Return the number of the trajectory of each item, shape (items,)."""
        if self._steps > _STEPS:
            return self._ends.searchsorted(items, "right")
        found = self._table.take(items >> self._shift)
        for _ in range(self._steps):
            found += self._ends.take(found, mode="clip") <= items
        return found
