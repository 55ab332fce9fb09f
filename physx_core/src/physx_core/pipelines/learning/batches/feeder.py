"""Feeder: a thread that produces a training's next items while the network learns."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Generic, ParamSpec, Protocol, TypeVar

from physx_core.processes import BackgroundThread

_MOST_ITEMS = 64
_MOST_BYTES = 64 << 20


class Item(Protocol):
    """An item that a feeder produces."""

    @property
    def nbytes(self) -> int:
        """Size in memory in bytes."""


P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T", bound=Item)


class _Closing(BaseException):
    """The feeder is being closed: unwinds its thread."""


class _Call:
    """A call that the training's thread makes on behalf of the feeder's."""

    def __init__(self, function: Callable[[], Any], *, is_awaited: bool) -> None:
        self.is_awaited, self.is_done = is_awaited, False
        self._function = function
        self._result: Any = None
        self._error: Exception | None = None

    def make(self) -> None:
        """Call the function; `result` raises its errors."""
        try:
            self._result = self._function()
        except Exception as error:
            self._error = error
        self.is_done = True

    def result(self) -> Any:
        """Return what the function returned, or raise what it raised."""
        if self._error is not None:
            raise self._error
        return self._result


class Feeder(Generic[T]):
    """Produces items in its own thread, in order, ahead of the training that takes them.

    Functions that may be called only in the training's thread, such as those of a network or an
    observer, are wrapped with `calling` or `telling`: when the feeder's thread calls them, they run
    in the training's thread while it waits for the next item. Items and calls keep their order:
    when a call is made, the training has taken all earlier items and is done with them.

    Attributes:
        waited: Time in s for which nothing was produced for lack of space, except for items of
            count 0.
    """

    def __init__(self) -> None:
        """Prepare; `start` starts the thread."""
        self._changed = threading.Condition()
        self._queue: deque[T | _Call | BaseException] = deque()
        self._counts: deque[int] = deque()
        self._taken = self._expected = 0
        self._items = self._nbytes = 0  # waiting to be taken
        self.waited = 0.0
        self._closes = False
        self._thread: threading.Thread | None = None

    def calling(self, function: Callable[P, R]) -> Callable[P, R]:
        """Wrap a function so that it is called in the training's thread.

        In the feeder's thread, the wrapper waits for the result; in any other, it calls the
        function directly.
        """

        def call(*arguments: P.args, **options: P.kwargs) -> R:
            if threading.current_thread() is not self._thread:
                return function(*arguments, **options)
            request = _Call(partial(function, *arguments, **options), is_awaited=True)
            with self._changed:
                self._put(request)
                self._wait_until(lambda: request.is_done)
            result: R = request.result()
            return result

        return call

    def telling(self, function: Callable[P, None]) -> Callable[P, None]:
        """Wrap a function like `calling`, but without waiting; the function must never raise."""

        def tell(*arguments: P.args, **options: P.kwargs) -> None:
            if threading.current_thread() is not self._thread:
                function(*arguments, **options)
                return
            with self._changed:
                self._put(_Call(partial(function, *arguments, **options), is_awaited=False))

        return tell

    def start(self, make: Callable[[int], T], cancel: Callable[[], None]) -> None:
        """Start the thread.

        Args:
            make: Produces the next item of a given count.
            cancel: Called by `close`; makes a running call of `make` end soon.
        """
        self._make, self._cancel = make, cancel
        self._thread = BackgroundThread(self._run, "physx-feeder")
        self._thread.start()

    def expect(self, counts: Iterable[int]) -> None:
        """Produce further items of these counts, as far as there is space for them.

        They wait in memory: up to 64 items and 64 MiB, but at least one.
        """
        with self._changed:
            before = len(self._counts)
            self._counts.extend(counts)
            self._expected += len(self._counts) - before
            self._changed.notify_all()

    def next(self, count: int) -> T:
        """Make the calls that come before the next item, and return the item.

        Args:
            count: Its count, if it was not expected yet.

        Raises:
            BaseException: Whatever producing the item raised.
        """
        if self._taken == self._expected:
            self.expect((count,))
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue)
                first = self._queue[0]
                if isinstance(first, BaseException):  # it stays: nothing follows
                    raise first
                self._queue.popleft()
                if not isinstance(first, _Call):
                    self._taken += 1
                    self._items -= 1
                    self._nbytes -= first.nbytes
                    self._changed.notify_all()
                    return first
            first.make()
            with self._changed:
                self._changed.notify_all()

    def close(self) -> None:
        """End the thread, and make the pending calls without a result; idempotent.

        Items that were not taken are lost.
        """
        with self._changed:
            self._closes = True
            self._changed.notify_all()
        if self._thread is None:
            return
        self._cancel()
        try:
            self._thread.join()
        except BaseException:  # a second Ctrl-C
            self._thread.join()
            raise
        self._thread = None
        queue, self._queue = self._queue, deque()
        for entry in queue:
            if isinstance(entry, _Call) and not entry.is_awaited:
                entry.make()

    # In the feeder's thread ---------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    self._wait_until(lambda: self._counts)
                    began = time.monotonic()
                    self._wait_until(self._has_room)
                    count = self._counts.popleft()
                    self.waited += time.monotonic() - began if count else 0.0
                item = self._make(count)
                with self._changed:
                    self._items += 1
                    self._nbytes += item.nbytes
                    self._put(item)
        except BaseException as error:
            with self._changed:
                self._queue.append(error)
                self._changed.notify_all()

    def _has_room(self) -> bool:
        return not self._items or (self._items < _MOST_ITEMS and self._nbytes < _MOST_BYTES)

    def _put(self, entry: T | _Call) -> None:
        self._queue.append(entry)
        self._changed.notify_all()

    def _wait_until(self, is_met: Callable[[], object]) -> None:
        self._changed.wait_for(lambda: self._closes or is_met())
        if self._closes:
            raise _Closing
