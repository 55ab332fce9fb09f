"""MixingBuffer: base of the buffers that draw each batch from many rows."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from physx_core.components.buffer import Buffer
from physx_core.errors import ConfigError
from physx_core.typing import Index

Mask: TypeAlias = NDArray[np.bool_]


class MixingBuffer(Buffer):
    """Waits for ``watermark`` rows, then for one row per ``views`` rows of the batches.

    So rows are used ``views`` times on average. The environments generate as many rows as the
    batches of the whole run need: the last batches are drawn when no more rows arrive.
    """

    def __init__(
        self, capacity: int = 10_000, watermark: int | None = None, views: int = 1
    ) -> None:
        """Set the options.

        Args:
            capacity: Number of rows that are kept in memory.
            watermark: Number of rows that must have arrived before the first batch; None: see
                `default_watermark`.
            views: How many times a row is used, on average.

        Raises:
            ConfigError: If an option has an invalid value.
        """
        for name, value in (("capacity", capacity), ("watermark", watermark), ("views", views)):
            optional = name == "watermark" and value is None
            if not optional and (type(value) is not int or value < 1):
                raise ConfigError(
                    f"{type(self).__name__}: {name} is {value!r} but must be a whole number of at "
                    "least 1."
                )
        self.capacity, self.watermark, self.views = capacity, watermark or 0, views

    def begin(self, batch_size: int, batch_nb: int, seed: int) -> None:
        """Start empty: see `Buffer.begin`."""
        super().begin(batch_size, batch_nb, seed)
        self.watermark = self.watermark or self.default_watermark
        name, most = type(self).__name__, self.most_waiting
        if self.watermark < batch_size:
            raise ConfigError(
                f"{name}: watermark is {self.watermark} but must be at least the batch size, "
                f"{batch_size}, so that a batch holds distinct rows."
            )
        if most > self.capacity:
            raise ConfigError(
                f"{name}: capacity is {self.capacity}, but with watermark {self.watermark} and "
                f"views {self.views} up to {most} rows are kept. Enlarge capacity, or lower "
                "watermark."
            )
        uses = batch_nb * batch_size
        self._total = max(self.watermark, -(-uses // self.views))

    @property
    def default_watermark(self) -> int:
        """A tenth of the capacity, and at least one batch."""
        return max(self.batch_size, self.capacity // 10)

    @property
    def most_waiting(self) -> int:
        """Number of rows that need a slot."""
        return self.watermark

    @property
    def held(self) -> int:
        """Number of rows in a buffer that fills its slots in order."""
        return min(self.arrived, self.capacity)

    def needed(self, batch: int) -> int:
        """Return how many rows must have arrived before a batch: see `Buffer.needed`."""
        return min(self._total, self.watermark + batch * self.batch_size // self.views)

    def draw(self, random: np.random.Generator) -> Index:
        """Return distinct slots of rows, each with the same probability."""
        return random.choice(self.held, self.batch_size, replace=False)

    def is_allowed(self, slots: Index | slice) -> Mask:
        """Return which of the given slots `pick` may return."""
        return self.rows[slots] >= 0

    def pick(self, count: int, random: np.random.Generator) -> Index:
        """Return distinct allowed slots, each with the same probability.

        A few candidates are enough unless few slots are allowed; then all are checked. The result
        is empty if fewer than `count` are allowed.
        """
        candidates = random.integers(0, self.capacity, 4 * count)
        candidates = candidates[self.is_allowed(candidates)]
        first = np.sort(np.unique(candidates, return_index=True)[1])
        if len(first) >= count:
            return candidates[first[:count]]
        allowed = np.flatnonzero(self.is_allowed(slice(None)))
        if len(allowed) < count:
            return allowed[:0]
        return random.choice(allowed, count, replace=False)
