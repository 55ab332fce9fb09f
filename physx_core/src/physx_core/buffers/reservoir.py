"""Reservoir: batches from rows of all ages."""

from __future__ import annotations

import numpy as np

from physx_core.buffers.mixing import Mask, MixingBuffer
from physx_core.typing import Index


class Reservoir(MixingBuffer):
    """Once it is full, a new row replaces a random one of those already used.

    So every row is used at least once while rows arrive, and the kept rows are of all ages, with
    more newer than older ones. Batches are drawn uniformly from all of them.
    """

    def place(self, count: int, random: np.random.Generator) -> Index:
        """Return empty slots, then random slots of used rows: see `Buffer.place`."""
        empty = np.arange(self.held, min(self.held + count, self.capacity))
        count -= len(empty)
        if not count:
            return empty
        picked = self.pick(count, random)
        if len(picked) < count:  # the run was extended, and many rows arrive at once
            picked = random.choice(self.capacity, count, replace=False)
        return np.concatenate([empty, picked])

    def is_allowed(self, slots: Index | slice) -> Mask:
        """Return which of the given slots hold a used row."""
        return self.uses[slots] > 0
