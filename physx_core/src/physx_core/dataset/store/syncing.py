"""Syncs written files to the disk about once a second, in a thread beside the writer."""

from __future__ import annotations

import os
import threading

PERIOD = 1.0
"""Seconds between two syncs of the same file."""


class Syncer:
    """Syncs files that were written to, in a thread that starts with the first of them.

    A power cut costs at most the rows of about the last second, while the writer never waits for
    the disk.
    """

    def __init__(self, period: float = PERIOD) -> None:
        self._period = period
        self._changed: dict[int, None] = {}
        self._retired: list[int] = []
        self._lock = threading.Lock()
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None

    def note(self, descriptor: int) -> None:
        """Schedule a file for the next sync."""
        if descriptor not in self._changed:
            with self._lock:
                self._changed[descriptor] = None
            self._wake.set()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="physx-sync", daemon=True)
                self._thread.start()

    def check(self) -> None:
        """Report a failure since the last call."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def retire(self, descriptor: int) -> None:
        """Close a file, after a last sync if it needs one."""
        with self._lock:
            if descriptor in self._changed:
                del self._changed[descriptor]
                self._retired.append(descriptor)
                return
        os.close(descriptor)

    def close(self) -> None:
        """Sync everything that is left, and end the thread."""
        self._end.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._sync()
        self.check()

    def _run(self) -> None:
        while not self._end.is_set():
            self._wake.wait()
            self._wake.clear()
            if not self._end.wait(self._period):
                self._sync()

    def _sync(self) -> None:
        with self._lock:
            copies, self._retired = self._retired, []
            try:
                copies.extend(os.dup(descriptor) for descriptor in self._changed)
            except OSError as error:
                self._error = error
            self._changed.clear()
        for descriptor in copies:
            try:
                os.fdatasync(descriptor)
            except OSError as error:
                self._error = error
            finally:
                os.close(descriptor)
