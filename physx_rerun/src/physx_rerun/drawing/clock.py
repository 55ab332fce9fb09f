"""SimulatedClock: the simulated time of one environment instance."""

from __future__ import annotations

from collections.abc import Sequence

from physx_core.components import Event


class SimulatedClock:
    """Tracks the simulated time reported by an instance; it keeps running across episodes.

    Attributes:
        seconds: The time in s; None: not known yet.
    """

    def __init__(self) -> None:
        self.seconds: float | None = None
        self._told = self._before = 0.0

    def read(self, events: Sequence[Event]) -> list[Event]:
        """Read the time from the events of a step, and return the other events."""
        others = []
        for event in events:
            if event.kind != "time":
                others.append(event)
                continue
            told = float(event.values["seconds"])
            if told < self._told:
                self._before += self._told
            self._told, self.seconds = told, self._before + told
        return others
