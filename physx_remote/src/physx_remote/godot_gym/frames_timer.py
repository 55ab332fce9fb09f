"""PhysicsFramesTimer, which counts physics frames; Signal, a list of callbacks."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any, Self


class Signal:
    """Functions to call on an event, in the order in which they were connected."""

    def __init__(self) -> None:
        self._functions: list[Callable[..., Any]] = []

    def connect(self, function: Callable[..., Any]) -> None:
        """Add a function unless it is already connected."""
        if function not in self._functions:
            self._functions.append(function)

    def disconnect(self, function: Callable[..., Any]) -> None:
        """Remove a function if it is connected."""
        if function in self._functions:
            self._functions.remove(function)

    def emit(self, *arguments: Any) -> list[Any]:
        """Call the functions and return their results."""
        return [function(*arguments) for function in self._functions]


class PhysicsFramesTimer:
    """Counts physics frames and emits a signal when more frames have started than its limit.

    Within `RLEnvironment._step`, ``yield timer.start()`` in a generator or ``await timer.start()``
    in a coroutine waits for it while physics runs.

    Attributes:
        timer_end: Signal without arguments, emitted when a frame beyond the limit starts.
        is_started: Whether it is counting.
    """

    def __init__(self, limit: int = 4) -> None:
        """Set the limit; `start` starts counting.

        Args:
            limit: Number of frames until the end, 0 or more.
        """
        self.timer_end = Signal()
        self.is_started = False
        self._limit = limit
        self._count = 0

    def set_limit(self, limit: int) -> None:
        """Set the number of frames until the end."""
        self._limit = limit

    def start(self) -> Self:
        """Restart from 0; return this timer."""
        self._count, self.is_started = 0, True
        return self

    def step(self) -> None:
        """Count a frame at its start."""
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
