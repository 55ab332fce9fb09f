"""PhysicsFramesTimer: time in physics frames; and signals, which tell that something happened."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, Self


class Signal:
    """Functions that are called when something happens, in the order in which they came."""

    def __init__(self) -> None:
        self._functions: list[Callable[..., Any]] = []

    def connect(self, function: Callable[..., Any]) -> None:
        """Call a function from now on; one that is called already is not called twice."""
        if function not in self._functions:
            self._functions.append(function)

    def disconnect(self, function: Callable[..., Any]) -> None:
        """Call a function no longer; one that is not called is left alone."""
        if function in self._functions:
            self._functions.remove(function)

    def emit(self, *arguments: Any) -> list[Any]:
        """Call the functions and return what they return."""
        return [function(*arguments) for function in self._functions]


class PhysicsFramesTimer:
    """Counts physics frames and tells once more of them begin than it was set to.

    Within `RLEnvironment._step` it can be waited for: ``yield timer.start()`` in a generator,
    ``await timer.start()`` in a coroutine. Physics runs meanwhile.

    Attributes:
        timer_end: Signal without arguments, when a frame beyond the limit begins.
        is_started: Whether it counts.
    """

    def __init__(self, limit: int = 4) -> None:
        """Keep the limit; `start` begins to count.

        Args:
            limit: How many frames pass until the end, 0 or more.
        """
        self.timer_end = Signal()
        self.is_started = False
        self._limit = limit
        self._count = 0

    def set_limit(self, limit: int) -> None:
        """Set how many frames pass until the end."""
        self._limit = limit

    def start(self) -> Self:
        """Count from 0 again; return the timer itself."""
        self._count, self.is_started = 0, True
        return self

    def step(self) -> None:
        """Count a frame that begins."""
        if not self.is_started:
            return
        self._count += 1
        if self._count > self._limit:
            self.is_started = False
            self.timer_end.emit()

    def __await__(self) -> Generator[PhysicsFramesTimer]:
        """Wait until the end."""
        if self.is_started:
            yield self

    __iter__ = __await__
