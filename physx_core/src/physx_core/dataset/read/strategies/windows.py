"""Reads blocks of rows from disk and shuffles rows within a window of many blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physx_core.dataset.read.strategies.disk import DiskColumn
from physx_core.dataset.read.strategies.ordered import OrderedColumn
from physx_core.errors import DatasetError
from physx_core.typing import Batch, Index

# The order depends on these sizes, not on the free memory, so a seed reproduces it on any machine.
_BLOCK = 2**19
_WINDOW_BLOCKS = 64


def block_rows(row_nbytes: int) -> int:
    """Return the number of rows in a block, for the bytes of a row of all fields together."""
    return max(1, _BLOCK // max(1, row_nbytes))


class WindowedEpoch:
    """A pass over rows on disk, block by block.

    Blocks of consecutive rows, half a megabyte each, are read in random order; 64 of them at a time
    are held in memory and their rows shuffled. Each row thus occurs once, and a batch draws from 64
    places of the dataset. The order depends on the seed and on the fields that are read. Without a
    random generator, rows come in the order of writing.

    Attributes:
        rows: Number of rows.
    """

    def __init__(
        self,
        columns: Sequence[DiskColumn | OrderedColumn],
        random: np.random.Generator | None,
        subset: Index | None = None,
        block: int | None = None,
    ) -> None:
        """Draw the order of the blocks and announce the first ones.

        Args:
            columns: The fields.
            random: Draws the order; None: the order of writing.
            subset: Numbers of the rows to read, ascending; None: all.
            block: Number of rows in a block; None: half a megabyte of them.
        """
        self._total = columns[0].shape[0]
        self.rows = self._total if subset is None else len(subset)
        self._columns, self._random, self._subset = columns, random, subset
        row_nbytes = sum(column.row_nbytes for column in columns)
        self._block = block or block_rows(row_nbytes)
        number = -(-self._total // self._block)
        self._blocks = np.arange(number) if random is None else random.permutation(number)
        if random is None:  # nothing is shuffled: a window of a few megabytes suffices
            self._window_blocks = max(1, 8 * _BLOCK // max(1, self._block * row_nbytes))
        else:
            self._window_blocks = _WINDOW_BLOCKS
        most = min(self._total, self._window_blocks * self._block)
        self._windows = [np.empty((most, *c.shape[1:]), c.dtype) for c in columns]
        self._order: Index | None = None
        self._next_block, self._used, self._held = 0, 0, 0
        self._announce()

    def fill(self, start: int, batch: Batch) -> None:
        """Copy the next rows: see `Epoch`."""
        outs = list(batch.values())
        done, count = 0, len(outs[0])
        while done < count:
            while self._used == self._held:
                self._read_window()
            first, part = self._used, min(count - done, self._held - self._used)
            for window, out in zip(self._windows, outs, strict=True):
                target = out[done : done + part]
                if self._order is None:
                    target[...] = window[first : first + part]
                else:
                    window.take(self._order[first : first + part], 0, target, "clip")
            self._used, done = first + part, done + part

    def close(self) -> None:
        """Close the files."""
        for column in self._columns:
            column.close()

    def _read_window(self) -> None:
        """Read the next window and announce the one after it."""
        if self._next_block >= len(self._blocks):
            raise DatasetError("Rows were removed since it was chosen which ones to read.")
        held = 0
        for start, count in self._next_window():
            for column, window in zip(self._columns, self._windows, strict=True):
                column.slice(start, window[held : held + count])
            held += count if self._subset is None else self._keep(start, count, held)
        self._next_block += self._window_blocks
        self._announce()
        self._used, self._held = 0, held
        if self._random is not None:
            self._order = self._random.permutation(held)

    def _keep(self, start: int, count: int, held: int) -> int:
        """Move the block's rows that are in the subset to its front; return their number."""
        subset = self._subset if self._subset is not None else np.arange(0)
        first, last = np.searchsorted(subset, (start, start + count))
        kept = subset[first:last] - start
        for window in self._windows:
            window[held : held + len(kept)] = window[held : held + count][kept]
        return len(kept)

    def _announce(self) -> None:
        for start, count in self._next_window():
            for column in self._columns:
                column.announce(start, count)

    def _next_window(self) -> list[tuple[int, int]]:
        """Return the first row and the number of rows of each block in the next window."""
        blocks = self._blocks[self._next_block : self._next_block + self._window_blocks]
        starts = (blocks * self._block).tolist()
        return [(start, min(self._block, self._total - start)) for start in starts]
