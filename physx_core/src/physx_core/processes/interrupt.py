"""Ends runs cleanly after Ctrl-C and SIGTERM."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any

from physx_core.errors import PhysxError

_REPETITION = 0.5
"""Time in s within which a signal counts as a repetition: schedulers, terminals and ``timeout``
send it both to a process and to its group."""


class Terminated(SystemExit):
    """SIGTERM ended the run; the process exits with status 143."""

    def __init__(self) -> None:
        super().__init__(128 + signal.SIGTERM)


class Interrupt:
    """Record of whether a run was asked to end, and by which signal.

    Attributes:
        number: The first signal; 0 before any.
    """

    def __init__(self) -> None:
        self.forget()

    def __bool__(self) -> bool:
        """Return whether the run should end."""
        return self.number != 0

    def take(self, number: int, frame: FrameType | None) -> None:
        """Record the first signal; raise the exception at a second one."""
        if self.is_repeated():
            return
        if self.number:
            _raise(number, frame)
        self.note(number)

    def forget(self) -> None:
        """Reset to the state before any signal."""
        self.number, self._came = 0, float("-inf")

    def note(self, number: int) -> None:
        """Record a signal."""
        self.number, self._came = number, time.monotonic()

    def is_repeated(self) -> bool:
        """Return whether a signal that arrives now is a repetition of the recorded one."""
        return time.monotonic() - self._came < _REPETITION

    def end(self) -> None:
        """Raise the exception with which the signal ends a run.

        Raises:
            KeyboardInterrupt: For Ctrl-C.
            Terminated: For SIGTERM.
        """
        _raise(self.number, None)


_LAST = Interrupt()
"""The last signal whose exception was raised."""


def is_from_signal(error: BaseException) -> bool:
    """Return whether a signal, and not the user's code, raised the exception that ended a run."""
    if isinstance(error, KeyboardInterrupt):
        return _LAST.number == signal.SIGINT
    return isinstance(error, Terminated)


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Defer the first Ctrl-C or SIGTERM, and yield the record of whether it came.

    A second one, at least half a second later, ends the run immediately. Outside the main thread,
    and for signals that are already handled, nothing changes.
    """
    interrupt = Interrupt()
    usual: dict[int, tuple[Any, ...]] = {
        signal.SIGINT: (signal.default_int_handler,),
        signal.SIGTERM: (signal.SIG_DFL, _raise_first),
    }
    with _handled(interrupt.take, usual):
        yield interrupt


@contextlib.contextmanager
def raised_at_sigterm() -> Iterator[None]:
    """Raise `Terminated` at SIGTERM, so that everything is closed before the process exits.

    An exception during an import may turn into any other. After SIGTERM, this context therefore
    always raises `Terminated`, with a physx error attached as a note. A further SIGTERM, at least
    half a second later, is raised again. Outside the main thread, and if SIGTERM is already
    handled, nothing changes.
    """
    with _handled(_raise_first, {signal.SIGTERM: (signal.SIG_DFL,)}) as before:
        if before:
            _LAST.forget()
        try:
            yield
        except Exception as error:
            if not before or _LAST.number != signal.SIGTERM:
                raise
            terminated = Terminated()
            if isinstance(error, PhysxError):
                terminated.add_note(str(error))
            raise terminated from error


def _raise_first(number: int, frame: FrameType | None) -> None:
    if not _LAST.is_repeated():
        _raise(number, frame)


def _raise(number: int, frame: FrameType | None) -> None:
    _LAST.note(number)
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


@contextlib.contextmanager
def _handled(
    handler: Callable[[int, FrameType | None], None], usual: Mapping[int, tuple[Any, ...]]
) -> Iterator[Mapping[int, Any]]:
    """Handle those signals that have one of their usual handlers, and yield the latter."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        current = {number: signal.getsignal(number) for number in usual}
        before = {number: kept for number, kept in current.items() if kept in usual[number]}
    for number in before:
        signal.signal(number, handler)
    try:
        yield before
    finally:
        for number, kept in before.items():
            signal.signal(number, kept)
