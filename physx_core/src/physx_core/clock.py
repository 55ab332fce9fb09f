"""Clock: what code that reads time or sleeps is given, so that tests can simulate time."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Time as a run sees it."""

    def monotonic(self) -> float:
        """Return the time in s since a fixed moment; it never goes back."""

    def sleep(self, seconds: float, /) -> None:
        """Return after a time in s."""


class _SystemClock:
    # The functions themselves: a method would add a call to each reading.
    monotonic = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)


SYSTEM_CLOCK: Clock = _SystemClock()
"""The clock of this machine."""
