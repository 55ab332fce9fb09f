"""Changes: what an environment instance has changed since it was last drawn."""

from __future__ import annotations

from collections.abc import Iterable

from physx_core.components import Event

_POSE = {"position", "orientation"}


class Changes:
    """Collects the events of several steps, and keeps only the last values.

    Attributes:
        step: The last step.
    """

    def __init__(self) -> None:
        self.step = 0
        self._events: list[Event] = []
        self._moves: dict[tuple[str, ...], Event] = {}
        self._looks: dict[str, Event] = {}

    def add(self, step: int, events: Iterable[Event]) -> bool:
        """Add the events of a step.

        Returns:
            Whether there are only changes to objects, which can wait for those of later steps.
        """
        self.step, can_wait = step, True
        for event in events:
            if event.action == "update":
                self._join(event)
            else:  # the order relative to earlier changes must be kept
                self._events = [*self.pop(), event]
                can_wait = False
        return can_wait

    def _join(self, event: Event) -> None:
        """Merge a change with earlier changes to the same objects."""
        moves = {option: event.values[option] for option in _POSE & event.values.keys()}
        looks = {option: event.values[option] for option in event.values.keys() - moves.keys()}
        if moves:
            key = (*event.names, "", *sorted(moves))
            self._moves.pop(key, None)  # the later change has its own place in the order
            self._moves[key] = Event("update", event.kind, event.names, moves)
        for one in Event("update", event.kind, event.names, looks).each() if looks else ():
            before = self._looks.pop(one.name, None)
            known = {} if before is None else dict(before.values)
            if "color" in looks:
                known.pop("scalar_field", None)  # replaced by the color
            self._looks[one.name] = Event("update", one.kind, one.names, {**known, **one.values})

    def pop(self) -> list[Event]:
        """Return and clear the events."""
        events = [*self._events, *self._moves.values(), *self._looks.values()]
        self._events, self._moves, self._looks = [], {}, {}
        return events
