"""Timers: what is to be done some time from now, in one thread."""

from __future__ import annotations

import heapq
import itertools
import math
import time
from collections.abc import Callable


class Timers:
    """Functions that wait for their moment.

    Attributes:
        next: When the first of them is due, in monotonic s; infinite without any.
    """

    def __init__(self) -> None:
        """Begin without any."""
        self.next = math.inf
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def add(self, seconds: float, action: Callable[[], None]) -> None:
        """Have a function called once, some time from now."""
        heapq.heappush(self._heap, (time.monotonic() + seconds, next(self._numbers), action))
        self.next = self._heap[0][0]

    def call_due(self) -> None:
        """Call those whose moment has come, in the order of their moments."""
        now = time.monotonic()
        while self.next <= now:
            action = heapq.heappop(self._heap)[2]
            self.next = self._heap[0][0] if self._heap else math.inf
            action()
