"""Observers: passes a run's events to several observers, whose errors cannot end the run."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from physx_core.components.scene.event import Event
from physx_core.components.visualizer import Observer
from physx_core.fields import Field
from physx_core.processes import is_ending
from physx_core.typing import Array

_LISTS = ("announcements", "touch", "outputs")
"""The methods that return a list."""


class Observers(Observer):
    """Passes everything to each observer; one that raises is reported once, then disabled."""

    def __init__(self, observers: Iterable[Observer]) -> None:
        self._observers = list(observers)
        self._muted: list[Observer] = []
        self._calls: dict[str, list[tuple[Observer, Callable[..., Any]]]] = {}

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Announce a run. Here observers' errors are raised, because the user can fix them.

        Raises:
            PhysxError: If an observer cannot start, for example because a viewer is unreachable.
        """
        opened: list[Observer] = []
        try:
            for observer in self._observers:
                opened.append(observer)
                observer.open(run_name, session_dir, instance_nb)
        except BaseException:
            self._observers = opened
            self.close()
            raise

    def announcements(self) -> Sequence[str]:
        """Return the lines of all observers."""
        return [line for lines in self._call("announcements") for line in lines]

    def begin(self, task: str, total: int | None, unit: str) -> None:
        """Announce a loop."""
        self._call("begin", task, total, unit)

    def advance(self, count: int) -> None:
        """Report the progress of the loop."""
        if self._calls.get("advance", True):  # after every sample of a run
            self._call("advance", count)

    def end(self) -> None:
        """Announce the end of the loop."""
        self._call("end")

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Pass on numbers."""
        self._call("scalars", values, step, timeline)

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Pass on arrays."""
        self._call("histograms", values, step, timeline)

    def fields(self, fields: Sequence[Field]) -> None:
        """Pass on fields."""
        self._call("fields", fields)

    def predictions(
        self, predicted: Mapping[str, Array], truth: Mapping[str, Array], step: int, timeline: str
    ) -> None:
        """Pass on predictions and the truth."""
        self._call("predictions", predicted, truth, step, timeline)

    @property
    def want_predictions(self) -> bool:
        """Whether any observer uses predictions."""
        ignored = Observer.predictions
        return any(type(each).predictions is not ignored for each in self._observers)

    def flush(self) -> None:
        """Have observers store everything that they received."""
        self._call("flush")

    def note(self, text: str) -> None:
        """Pass on a message."""
        self._call("note", text)

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Pass on drawing events."""
        self._call("events", instance_id, step, events)

    def touch(self, instance_id: int) -> Sequence[float]:
        """Return what a person does in the first observer that has sliders and is touched."""
        return next(filter(len, self._call("touch", instance_id)), ())

    def close(self) -> None:
        """Announce the end of the run."""
        self._call("close")

    def outputs(self) -> Sequence[str]:
        """Return the lines of all observers, including those that have failed."""
        self._observers, self._muted, self._calls = [*self._observers, *self._muted], [], {}
        return [line for lines in self._call("outputs") for line in lines]

    def _call(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of each observer that has its own, and return what they return."""
        if method not in self._calls:
            empty = getattr(Observer, method)
            calls = [(each, getattr(each, method)) for each in self._observers]
            self._calls[method] = [
                call for call in calls if getattr(call[1], "__func__", None) is not empty
            ]
        returned = []
        for observer, call in self._calls[method]:
            try:
                found = call(*arguments)
                if method in _LISTS and (isinstance(found, str) or not isinstance(found, Sequence)):
                    raise TypeError(f"{method}() returned {found!r:.100}, not a list")
                returned.append(found)
            except BaseException as error:
                if not isinstance(error, Exception) and not is_ending(error):
                    raise
                # New lists: this loop continues with the old one.
                self._observers = [other for other in self._observers if other is not observer]
                self._calls = {}
                self._muted.append(observer)
                warnings.warn(
                    f"{type(observer).__name__} failed and is disabled from here on: "
                    f"{type(error).__name__}: {error}",
                    stacklevel=3,
                )
        return returned
