"""Addresses: numbers of stored rows that never change, though rows before them may be removed."""

from __future__ import annotations

import numpy as np

from physx_core.dataset.store.manifest import Mode
from physx_core.typing import Index


class Addresses:
    """Where the rows with given addresses are stored in a mode now.

    Attributes:
        end: Address after the last stored row.
        rows: Number of stored rows.
    """

    def __init__(self, mode: Mode) -> None:
        """Look at the mode's partitions as they are now."""
        self._first, self._rows = (
            np.array([(part.first_row, part.rows) for part in mode.with_rows], np.int64)
            .reshape(-1, 2)
            .T
        )
        self._starts = np.cumsum(self._rows) - self._rows
        self.end = int((self._first + self._rows).max(initial=0))
        self.rows = int(self._rows.sum())

    def stored_before(self, addresses: Index) -> Index:
        """Return the number of stored rows before each address."""
        if not len(self._first):
            return np.zeros(len(addresses), np.int64)
        group = np.maximum(self._first.searchsorted(addresses, "right") - 1, 0)
        inside = np.clip(addresses - self._first[group], 0, self._rows[group])
        found: Index = self._starts[group] + inside
        return found

    def stored(self, address: int) -> int:
        """Return the number of stored rows before an address."""
        return int(self.stored_before(np.array([address]))[0])

    @property
    def runs(self) -> tuple[Index, Index]:
        """The first stored row of each run of rows with consecutive addresses, and its address."""
        if not len(self._first):
            return np.zeros(1, np.int64), np.zeros(1, np.int64)
        new = np.append(True, self._first[1:] != (self._first + self._rows)[:-1])
        return self._starts[new], self._first[new]

    def has_all(self, first: int, count: int) -> bool:
        """Return whether there are rows with all `count` addresses from the first on."""
        begin, end = self.stored_before(np.array([first, first + count]))
        return bool(end - begin == count)
