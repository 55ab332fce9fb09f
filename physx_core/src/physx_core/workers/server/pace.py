"""Pace: how fast each client generates rows, and which clients hold up the run."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from physx_core.clock import SYSTEM_CLOCK, Clock

_HELD = 5.0  # s that the run waits for an instance before it is reported
_SLOW = 2.0
_LONGEST = 0.2  # s, limit for the time between two looks; any excess has other causes


class Pace:
    """Time that a client spends on its rows, without its waits for the server.

    Counting starts when the first rows arrive: earlier rows may have been generated again.
    """

    def __init__(self, clock: Clock = SYSTEM_CLOCK) -> None:
        """Start before the first row."""
        self._clock = clock
        self._rows, self._seconds = 0, 0.0
        self._has_begun = False
        self._since: float | None = None

    @property
    def per_row(self) -> float | None:
        """Time per row in s; None until it is known."""
        return self._seconds / self._rows if self._rows else None

    def rows(self, count: int, *, goes_on: bool) -> None:
        """Count rows that arrived.

        Args:
            count: How many.
            goes_on: Whether the client now generates more.
        """
        if self._since is not None:
            self._rows += count
        self.rest()
        self._has_begun = True
        if goes_on:
            self.go_on()

    def rest(self) -> None:
        """Note that the client waits for the server."""
        if self._since is not None:
            self._seconds += self._clock.monotonic() - self._since
            self._since = None

    def leave_out(self) -> None:
        """Do not count the rows that are being generated: when they arrive will say nothing."""
        self._since = None

    def go_on(self) -> None:
        """Note that the client no longer waits for the server."""
        if self._has_begun and self._since is None:
            self._since = self._clock.monotonic()


class Laggard(NamedTuple):
    """An instance that holds up the run.

    Attributes:
        instance_id: Its number.
        per_row: Its time per row, in s.
        median: Median of that time over the instances, in s.
    """

    instance_id: int
    per_row: float
    median: float


class Laggards:
    """Finds instances that are much slower than the others and hold up the run."""

    def __init__(self, clock: Clock = SYSTEM_CLOCK) -> None:
        """Start with none."""
        self._held: defaultdict[int, float] = defaultdict(float)
        self._looked = clock.monotonic()

    def note(self, waited: Iterable[int], now: float) -> None:
        """Note which instances the run waits for now; none if it waits for most of them."""
        elapsed = min(now - self._looked, _LONGEST)
        self._looked = now
        for number in waited:
            self._held[number] += elapsed

    def find(self, paces: Mapping[int, float]) -> list[Laggard]:
        """Return the instances that have held up the run since they were last returned.

        An instance is slow if its time per row is at least twice the median.

        Args:
            paces: Instance to time per row, in s.
        """
        held = [number for number, seconds in self._held.items() if seconds >= _HELD]
        if not held or len(paces) < 2:
            return []
        median = statistics.median_low(paces.values())
        found = []
        for number in held:
            if paces.get(number, 0.0) >= _SLOW * median:
                del self._held[number]
                found.append(Laggard(number, paces[number], median))
        return found
