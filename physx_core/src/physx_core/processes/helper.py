"""Helper: does jobs beside the thread that gives them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Generic, TypeVar

from physx_core.closeable import Closeable
from physx_core.processes.thread import BackgroundThread

T = TypeVar("T")


class Helper(Closeable, Generic[T]):
    """Does jobs one after another, in the order given, in a thread that starts with the first.

    Attributes:
        pending: Number of jobs whose results have not been taken.
    """

    def __init__(self, name: str, *, inline: bool = False) -> None:
        """Start without jobs.

        Args:
            name: Name of the thread, shown in tracebacks and by debuggers.
            inline: Whether each job is done when it is given, without a thread: for tests.
        """
        self.pending = 0
        self._name, self._inline = name, inline
        self._jobs: SimpleQueue[Callable[[], T] | None] = SimpleQueue()
        self._done: SimpleQueue[Callable[[], T]] = SimpleQueue()
        self._closes = threading.Event()
        self._thread: BackgroundThread | None = None

    def give(self, job: Callable[[], T]) -> None:
        """Have a job done; `take` returns its result."""
        if self._inline:
            self._done.put(_do(job))
        else:
            if self._thread is None:
                self._thread = BackgroundThread(self._run, self._name)
                self._thread.start()
            self._jobs.put(job)
        self.pending += 1

    @property
    def is_ready(self) -> bool:
        """Whether `take` would return at once."""
        return not self._done.empty()

    def take(self) -> T:
        """Wait for the next job, in the order given; return its result, or raise its error."""
        done = self._done.get()
        self.pending -= 1
        return done()

    def drain(self) -> None:
        """Wait until all jobs are done; raise the error of the first that failed."""
        while self.pending:
            self.take()

    def pause(self, seconds: float) -> None:
        """Called by a job: wait for a time in s, but no longer once the helper is closed."""
        if not self._inline:
            self._closes.wait(seconds)

    def close(self) -> None:
        """Do all jobs that were given, and end the thread; what they return or raise is lost."""
        self._closes.set()
        self._jobs.put(None)
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            done = _do(job)
            del job  # it may hold rows, which the next `get` would keep
            self._done.put(done)
            del done


def _do(job: Callable[[], T]) -> Callable[[], T]:
    """Do a job; return a function that returns what it returned, or raises what it raised."""
    try:
        result = job()
    except BaseException as failed:
        error = failed

        def fail() -> T:
            raise error

        return fail
    return lambda: result
