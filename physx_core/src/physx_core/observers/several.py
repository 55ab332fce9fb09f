"""Observers: several observers as one, of which none can end a run."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from physx_core.components.scene import Event
from physx_core.components.visualizer import Observer
from physx_core.typing import Array


class Observers(Observer):
    """Hands everything to each observer; one that raises is reported once and left out."""

    def __init__(self, observers: Iterable[Observer]) -> None:
        self._observers = list(observers)

    def open(self, run_name: str, session_dir: Path, instance_nb: int) -> None:
        """Tell all that a run begins. An observer that cannot begin is an error of the user's.

        Raises:
            PhysxError: An observer cannot begin, for example a viewer that is not there.
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

    def begin(self, task: str, total: int | None, unit: str) -> None:
        """Tell all that a loop begins."""
        self._each(lambda observer: observer.begin(task, total, unit))

    def advance(self, count: int) -> None:
        """Tell all that the loop went on."""
        for observer in self._observers:
            try:
                observer.advance(count)
            except Exception as error:
                self._mute(observer, error)

    def end(self) -> None:
        """Tell all that the loop is over."""
        self._each(lambda observer: observer.end())

    def scalars(self, values: Mapping[str, float], step: int, timeline: str) -> None:
        """Give numbers to all."""
        for observer in self._observers:
            try:
                observer.scalars(values, step, timeline)
            except Exception as error:
                self._mute(observer, error)

    def histograms(self, values: Mapping[str, Array], step: int, timeline: str) -> None:
        """Give arrays to all."""
        self._each(lambda observer: observer.histograms(values, step, timeline))

    def note(self, text: str) -> None:
        """Tell all that something happened."""
        self._each(lambda observer: observer.note(text))

    def events(self, instance_id: int, step: int, events: list[Event]) -> None:
        """Give drawing events to all."""
        self._each(lambda observer: observer.events(instance_id, step, events))

    def close(self) -> None:
        """Tell all that the run is over."""
        self._each(lambda observer: observer.close())

    def _each(self, call: Callable[[Observer], Any]) -> None:
        for observer in list(self._observers):
            try:
                call(observer)
            except Exception as error:
                self._mute(observer, error)

    def _mute(self, observer: Observer, error: Exception) -> None:
        # A new list: the loop that called this may still go through the old one.
        self._observers = [other for other in self._observers if other is not observer]
        name = type(observer).__name__
        summary = f"{type(error).__name__}: {error}"
        warnings.warn(f"{name} failed and is left out from here on: {summary}", stacklevel=4)
