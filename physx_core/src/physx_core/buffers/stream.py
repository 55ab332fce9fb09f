"""Stream: uses each row once, in order of arrival."""

from __future__ import annotations

from physx_core.components.buffer import Buffer


class Stream(Buffer):
    """Keeps nothing: each batch consists of the next rows."""

    def needed(self, batch: int) -> int:
        """Return how many rows must have arrived before a batch: see `Buffer.needed`."""
        return (batch + 1) * self.batch_size
