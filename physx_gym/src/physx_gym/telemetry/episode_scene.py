"""EpisodeScene: records drawings, contacts, and moved objects of an episode, step by step."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from physx_core.components import Factory
from physx_core.typing import Vector
from physx_sim import Simulation

_MOST_NUMBERS = 1_000_000  # in all changes: a log's description must stay readable
_WITHOUT = ("view", "time")  # kinds of events that replays generate themselves

Draw = Callable[[Factory], None]


class EpisodeScene:
    """Records an episode's initial drawings, their changes, contact forces, and moved objects."""

    def __init__(self) -> None:
        self._factory = Factory()
        self._added: list[dict[str, Any]] = []
        self._changes: list[tuple[float, str, dict[str, Any]]] = []
        self._known: dict[tuple[str, str], Any] = {}
        self._numbers = 0
        self._contacts: list[Vector] = []
        self._moved: list[tuple[float, str, list[float], bool]] = []

    def begin(self, draw: Draw, simulation: Simulation) -> None:
        """Start over with the initial drawings, and where static and hidden objects are."""
        EpisodeScene.__init__(self)
        draw(self._factory)
        for event in self._factory.take_events():
            if event.kind not in _WITHOUT:
                values = dict(event.values)
                self._added.append({"kind": event.kind, "name": event.name, "values": values})
        self._record_moved(0.0, simulation)
        self._remember()

    def record(self, time: float, redraw: Draw, simulation: Simulation) -> None:
        """Record what changed in a step, and its contacts.

        Args:
            time: Since the start of the episode, in s.
            redraw: Updates the drawings.
            simulation: The simulation after the step.
        """
        redraw(self._factory)
        events = self._factory.take_events()
        for event in (one for several in events for one in several.each()):
            changes = {
                option: value
                for option, value in event.values.items()
                if not self._is_known(event.name, option, value)
            }
            size = sum(map(_size, changes.values()))
            if event.kind in _WITHOUT or not changes or self._numbers + size > _MOST_NUMBERS:
                continue
            self._numbers += size
            self._known |= {(event.name, option): value for option, value in changes.items()}
            self._changes.append((time, event.name, changes))
        self._record_moved(time, simulation)
        if "contacts" in simulation.features:
            found = simulation.contacts()
            if len(found):
                times = np.full((len(found), 1), time)
                self._contacts.append(np.hstack([times, found["point"], found["force"]]))

    def _record_moved(self, time: float, simulation: Simulation) -> None:
        """Record objects that `Simulation.set_body` moved or hid, where that changed.

        The states of an episode contain neither.
        """
        if "changes" not in simulation.features:
            return
        layout = simulation.layout
        for name in (*(each for each in layout.parts if each in layout.bodies), *layout.statics):
            settings = simulation.body_settings(name)
            pose = [*(settings.position or ()), *(settings.orientation or ())]
            now = pose, bool(settings.hidden)
            before = next((row[2:] for row in reversed(self._moved) if row[1] == name), ([], False))
            if now != before and self._numbers + len(pose) <= _MOST_NUMBERS:
                self._numbers += len(pose)
                self._moved.append((time, name, *now))

    def _is_known(self, name: str, option: str, value: Any) -> bool:
        key = name, option
        return key in self._known and bool(np.array_equal(value, self._known[key]))

    def rewind(self, time: float) -> None:
        """Discard everything recorded after a time, in s."""
        self._changes = [change for change in self._changes if change[0] <= time]
        self._moved = [moved for moved in self._moved if moved[0] <= time]
        self._contacts = [block for block in self._contacts if block[0, 0] <= time]
        self._remember()

    def _remember(self) -> None:
        """Store the state of every object at the end of the recording."""
        first = ((each["name"], each["values"]) for each in self._added)
        later = ((name, values) for _, name, values in self._changes)
        self._known = {
            (name, option): value
            for name, values in itertools.chain(first, later)
            for option, value in values.items()
        }

    def describe(self) -> Mapping[str, Any]:
        """Return its entries in a log: ``scene`` and ``contacts``.

        ``contacts`` has a row for each contact: time in s, point in m, force in N, both (3,) in the
        world frame.
        """
        changes = [list(change) for change in self._changes]
        contacts = np.concatenate([np.zeros((0, 7)), *self._contacts])
        moved = [list(each) for each in self._moved]
        scene = {"added": list(self._added), "changes": changes, "moved": moved}
        return {"scene": scene, "contacts": contacts}


def _size(value: Any) -> int:
    return sum(map(np.size, value)) if isinstance(value, list) else np.size(value)
