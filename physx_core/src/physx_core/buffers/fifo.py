"""Fifo: each row the same number of times, in random order."""

from __future__ import annotations

import numpy as np

from physx_core.buffers.mixing import MixingBuffer
from physx_core.typing import Index


class Fifo(MixingBuffer):
    """Draws each row exactly ``views`` times; after its last use it makes room for another.

    Batches are drawn at random from the rows that wait: a shuffle buffer. With more than one view
    rows wait for different numbers of uses, so there are slots for ``views`` times ``watermark``
    rows.
    """

    @property
    def default_watermark(self) -> int:
        """As many rows as there are always slots for, and at least one batch."""
        return max(self.batch_size, self.capacity // self.views)

    @property
    def most_waiting(self) -> int:
        """Number of rows for which there must be a slot, if each waits for its last use."""
        return self.watermark * self.views

    @property
    def kept(self) -> Index:
        """Numbers of the rows that wait: see `Buffer.kept`."""
        return self.rows[self._waiting()]

    def place(self, count: int, random: np.random.Generator) -> Index:
        """Return slots of no row or of a finished one: see `Buffer.place`."""
        return np.flatnonzero((self.rows < 0) | (self.uses >= self.views))[:count]

    def draw(self, random: np.random.Generator) -> Index:
        """Return slots of waiting rows, different ones if there are enough."""
        waiting = self._waiting()
        if len(waiting) < self.batch_size:
            waiting = np.repeat(waiting, self.views - self.uses[waiting])
        return random.choice(waiting, self.batch_size, replace=False)

    def _waiting(self) -> Index:
        return np.flatnonzero((self.rows >= 0) & (self.uses < self.views))
