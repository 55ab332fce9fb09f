"""Timers: call functions at later times, in one thread."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable

from physx_core.clock import SYSTEM_CLOCK, Clock


class Timers:
    """Functions to be called at later times.

    Attributes:
        clock: The clock that they follow.
        next: When the first of them is due, in monotonic s; infinity if there are none.
    """

    def __init__(self, clock: Clock = SYSTEM_CLOCK) -> None:
        """Start with none."""
        self.clock = clock
        self.next = math.inf
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def add(self, seconds: float, action: Callable[[], None]) -> None:
        """Schedule one call of a function, `seconds` from now."""
        heapq.heappush(self._heap, (self.clock.monotonic() + seconds, next(self._numbers), action))
        self.next = self._heap[0][0]

    def call_due(self) -> None:
        """Call all due functions in the order of their times."""
        now = self.clock.monotonic()
        while self.next <= now:
            action = heapq.heappop(self._heap)[2]
            self.next = self._heap[0][0] if self._heap else math.inf
            action()
