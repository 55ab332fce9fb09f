"""Group: the processes that train one network together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.typing import Array, Batch


class Group:
    """The processes that train one network together, each on its share of every batch.

    This class is the group of a single process; plugins derive groups for their libraries. All
    processes of a group must call its methods in the same order.

    Attributes:
        rank: Index of this process, from 0.
        size: Number of processes.
    """

    rank: int = 0
    size: int = 1

    @property
    def is_main(self) -> bool:
        """Whether this process writes the session, checkpoints, and statistics."""
        return self.rank == 0

    def broadcast(self, value: Any) -> Any:
        """Return the leading process's value in all processes.

        Args:
            value: Numbers, strings, arrays, and lists, tuples and dictionaries of those; ignored in
                the other processes.
        """
        return value

    def total(self, values: Sequence[float]) -> list[float]:
        """Return the sum of each number over all processes."""
        return list(values)

    def gather(self, values: Array) -> Array:
        """Return the numbers of all processes, in the order of their ranks.

        Args:
            values: This process's numbers, shape (n,); n may differ between processes.
        """
        counts = [float(len(values) if rank == self.rank else 0) for rank in range(self.size)]
        ends = np.cumsum(self.total(counts)).astype(int)
        end = ends[self.rank]
        whole = np.zeros(ends[-1])
        whole[end - len(values) : end] = values
        return np.array(self.total(whole.tolist()))

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set in any process."""
        return flag if self.size == 1 else self.total([float(flag)])[0] > 0

    def share_of(self, batch: Batch) -> tuple[Batch, float]:
        """Return this process's rows, and their weight in the mean over the whole batch.

        If a batch has fewer rows than there are processes, some processes get a row of weight 0.

        Args:
            batch: The whole batch, the same in all processes.
        """
        return self.share_for(self.rank, batch)

    def share_for(self, rank: int, batch: Batch) -> tuple[Batch, float]:
        """Return the rows of the process with a given rank, and their weight: see `share_of`."""
        rows = len(next(iter(batch.values())))
        first, last = rows * rank // self.size, rows * (rank + 1) // self.size
        own = slice(first, last) if last > first else slice(0, 1)
        return {name: values[own] for name, values in batch.items()}, (last - first) / rows

    def scatter(self, batch: Batch) -> tuple[Batch, float]:
        """Return this process's share of a batch that only the leading one has: see `share_of`.

        Args:
            batch: The whole batch; ignored in the other processes.
        """
        return self.share_of(batch)
