"""Changes: what an environment instance has changed since it was last drawn."""

from __future__ import annotations

from collections.abc import Iterable

from physx_core.components import Event


class Changes:
    """Collects the events of several steps, of which only the last values are kept.

    Attributes:
        step: The last step.
    """

    def __init__(self) -> None:
        self.step = 0
        self._events: dict[tuple[str, ...], Event] = {}

    def add(self, step: int, events: Iterable[Event]) -> bool:
        """Add the events of a step.

        Returns:
            Whether there are only changes of objects, which can wait for those of later steps.
        """
        self.step, can_wait = step, True
        for event in events:
            can_wait &= event.action == "update"
            key = (event.action, event.kind, *event.names, "", *sorted(event.values))
            self._events.pop(key, None)  # the later one has its own place in the order
            self._events[key] = event
        return can_wait

    def pop(self) -> list[Event]:
        """Return and forget the events."""
        events, self._events = list(self._events.values()), {}
        return events
