"""Event: objects of a scene that are added, changed or removed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Action = Literal["add", "update", "remove"]
ACTIONS = ("add", "update", "remove")


@dataclass(frozen=True)
class Event:
    """Objects of one kind that are added, changed or removed.

    Attributes:
        action: What happens to them.
        kind: Their kind, for example ``mesh``.
        names: Their names, unique in their environment.
        values: Options that are set: copies of arrays, and plain data. For several objects, each
            value has a leading axis with one entry for each object.
    """

    action: Action
    kind: str
    names: tuple[str, ...]
    values: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the object, or of the first of several."""
        return self.names[0]

    def each(self) -> Iterator[Event]:
        """Yield an event for each object."""
        if len(self.names) == 1:
            yield self
            return
        for row, name in enumerate(self.names):
            values = {option: value[row] for option, value in self.values.items()}
            yield Event(self.action, self.kind, (name,), values)
