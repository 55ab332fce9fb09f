"""Fifo: uses each row the same number of times, in random order."""

from __future__ import annotations

import heapq

import numpy as np

from physx_core.buffers.mixing import Mask, MixingBuffer
from physx_core.typing import Index


class Fifo(MixingBuffer):
    """Draws each row exactly ``views`` times; after its last use it makes room for another.

    Batches are drawn at random from the waiting rows: a shuffle buffer. With more than one view,
    rows wait for different numbers of uses, so there are slots for ``views`` times ``watermark``
    rows.
    """

    @property
    def default_watermark(self) -> int:
        """As many rows as there are always slots for, and at least one batch."""
        return max(self.batch_size, self.capacity // self.views)

    @property
    def most_waiting(self) -> int:
        """Number of rows that need a slot if each waits for its last use."""
        return self.watermark * self.views

    def begin(self, batch_size: int, batch_nb: int, seed: int) -> None:
        """Start empty: see `Buffer.begin`."""
        super().begin(batch_size, batch_nb, seed)
        self._find_free()

    def restore(self, batches: int, state: Index) -> None:
        """Continue from a state: see `Buffer.restore`."""
        super().restore(batches, state)
        self._find_free()

    def _find_free(self) -> None:
        """Find the slots without a row, which are the last ones, and those of finished rows."""
        self._never_used = int(np.count_nonzero(self.rows >= 0))
        self._finished = np.flatnonzero(self.uses >= self.views).tolist()  # sorted: a heap

    @property
    def kept(self) -> Index:
        """Numbers of the waiting rows: see `Buffer.kept`."""
        return self.rows[self._waiting()]

    def place(self, count: int, random: np.random.Generator) -> Index:
        """Return the first free slots: see `Buffer.place`."""
        again = min(count, len(self._finished))
        slots = [heapq.heappop(self._finished) for _ in range(again)]
        slots += range(self._never_used, self._never_used + count - again)
        self._never_used += count - again
        return np.array(slots)

    def draw(self, random: np.random.Generator) -> Index:
        """Return slots of waiting rows, distinct ones if there are enough."""
        drawn = self.pick(self.batch_size, random)
        if not len(drawn):
            waiting = self._waiting()
            left = np.repeat(waiting, self.views - self.uses[waiting])
            drawn = random.choice(left, self.batch_size, replace=False)
        slots, times = np.unique(drawn, return_counts=True)
        for slot in slots[self.uses[slots] + times >= self.views].tolist():
            heapq.heappush(self._finished, slot)
        return drawn

    def is_allowed(self, slots: Index | slice) -> Mask:
        """Return which of the given slots hold a waiting row."""
        return (self.rows[slots] >= 0) & (self.uses[slots] < self.views)

    def _waiting(self) -> Index:
        return np.flatnonzero(self.is_allowed(slice(None)))
