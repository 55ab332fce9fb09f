"""Random streams by number: one generator, set in place to the stream of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


class NumberedStreams:
    """The random streams of a run's episodes: Philox, with the number as part of its counter.

    Attributes:
        generator: At first it is at a stream that is none of those by number, and the same for
            every caller with the same seed. It cannot spawn others, since what these draw would
            depend on how often that was done before.
    """

    def __init__(self, seed: int | Sequence[int] | None) -> None:
        """Derive the key of the streams from the seed of a run."""
        key = np.random.SeedSequence(seed).generate_state(2, np.uint64)
        self._bits: Any = np.random.Philox(key=key, counter=[0, 0, 1, 0])
        self._counter = np.zeros(4, np.uint64)
        self._state: dict[str, Any] = {
            **self._bits.state,
            "state": {"key": key, "counter": self._counter},
        }
        self.generator = np.random.Generator(self._bits)

    def seek(self, number: int) -> None:
        """Set the generator in place to the beginning of a stream; each has 2^194 numbers."""
        self._counter[3] = number
        self._bits.state = self._state
