"""StoredRows: stored samples to send through environments, in passes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physx_core.dataset import Dataset
from physx_core.errors import DatasetError, listed
from physx_core.pipelines.storage import other_samples
from physx_core.pipelines.stored_sets import find_sets
from physx_core.rows import concatenate
from physx_core.typing import Batch

_AHEAD = 1 << 22

Index = NDArray[np.intp]


class StoredRows:
    """Rows of a mode, all of them in each pass: in the order of writing or a new random order.

    About 4 MB are read ahead, but not beyond the end of a pass, so the next pass reads rows that
    were replaced in the meantime. Rows that are added later are not included.

    Attributes:
        count: Number of rows in a pass.
    """

    def __init__(
        self,
        dataset: Dataset,
        mode: str,
        rows: Index | None = None,
        random: np.random.Generator | None = None,
    ) -> None:
        """Select the rows.

        Args:
            dataset: The dataset that contains the rows.
            mode: Their mode.
            rows: Indices of the rows of a pass; None: all current rows.
            random: Draws the order of each pass; None: the order of `rows`.
        """
        if not dataset.num_samples(mode):
            raise DatasetError(
                f'The dataset in {dataset.directory} has no samples of mode "{mode}" to send '
                f"through an environment. It has: {listed(dataset.modes)}."
                f"{other_samples(dataset.directory, mode)}"
            )
        self._view = dataset[mode]
        self._sets = find_sets(dataset, mode)
        self._rows = np.arange(dataset.num_samples(mode)) if rows is None else rows
        self.count = len(self._rows)
        self._random = random
        nbytes = sum(view.field.nbytes for _, view in self._view.items())
        self._ahead = max(1, _AHEAD // max(1, nbytes))
        self._order: Index = self._rows[:0]
        self._given = self._start = self._stop = 0
        self._block: Batch = {}

    def take(self, count: int) -> tuple[Index, Batch]:
        """Return the next rows of the pass, fewer than `count` at its end.

        Returns:
            Their indices in the mode, and the rows: field name to array of shape
            (rows, *field shape), and the parameters that they were generated with, if recorded: see
            `Instance.step`.
        """
        if self._given == len(self._order):
            random = self._random
            self._order = self._rows if random is None else random.permutation(self._rows)
            self._given = self._start = self._stop = 0
        first, last = self._given, min(self._given + count, self.count)
        if last > self._stop:
            self._start, self._stop = first, min(first + max(count, self._ahead), self.count)
            index = self._order[self._start : self._stop]
            self._block = {name: view[index] for name, view in self._view.items()}
            if self._sets is not None:
                self._block |= self._sets.of(index, self._block)
        self._given = last
        place = slice(first - self._start, last - self._start)
        return self._order[first:last], {name: rows[place] for name, rows in self._block.items()}

    def take_cyclic(self, count: int) -> Batch:
        """Return exactly `count` rows, starting the next pass if needed."""
        parts: list[Batch] = []
        while count:
            index, rows = self.take(count)
            parts.append(rows)
            count -= len(index)
        if len(parts) == 1:
            return rows
        return concatenate(parts)
