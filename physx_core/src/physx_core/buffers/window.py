"""Window: batches from the newest rows."""

from __future__ import annotations

import numpy as np

from physx_core.buffers.mixing import MixingBuffer
from physx_core.typing import Index


class Window(MixingBuffer):
    """Keeps the newest ``capacity`` rows, and draws uniformly from them."""

    def place(self, count: int, random: np.random.Generator) -> Index:
        """Return the slots of the oldest rows: see `Buffer.place`."""
        return np.arange(self.arrived, self.arrived + count) % self.capacity
