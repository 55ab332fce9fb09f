"""Group: the processes that train one network together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from physx_core.typing import Batch


class Group:
    """The processes that train one network together, each on its share of every batch.

    This class is the group of a process that trains alone; a plugin derives the one of its library.
    Every method must be called by all processes of the group, in the same order.

    Attributes:
        rank: Number of this process, counted from 0.
        size: Number of processes.
    """

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes what the group keeps: session, checkpoints, statistics."""
        return self.rank == 0

    def tell(self, value: Any) -> Any:
        """Return what the leading process gave.

        Args:
            value: Plain data that JSON can hold; that of the other processes is ignored.
        """
        return value

    def total(self, values: Sequence[float]) -> list[float]:
        """Return the sums of the numbers over all processes, each number by itself."""
        return list(values)

    def any(self, flag: bool) -> bool:
        """Return whether one of the processes has the flag set."""
        return flag if self.size == 1 else self.total([float(flag)])[0] > 0

    def share_of(self, batch: Batch) -> tuple[Batch, float]:
        """Return the rows of this process, and their weight in the mean over the whole batch.

        Where a batch has fewer rows than there are processes, some get a row without weight.

        Args:
            batch: The whole batch, the same in all processes.
        """
        rows = len(next(iter(batch.values())))
        first, last = rows * self.rank // self.size, rows * (self.rank + 1) // self.size
        own = slice(first, last) if last > first else slice(0, 1)
        return {name: values[own] for name, values in batch.items()}, (last - first) / rows
