"""BackgroundThread: a daemon thread that can always be joined."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

_START_TIME = 1.0  # s in which a thread runs whose start was interrupted, if it ever does
_PAUSE = 0.001


class BackgroundThread(threading.Thread):
    """A daemon thread that `join` waits for, although Ctrl-C may have interrupted its start.

    `threading.Thread.start` waits until the thread runs. An interrupt of that wait leaves a thread
    that will run, but that `threading.Thread.join` refuses as one that was never started.
    """

    def __init__(self, run: Callable[[], object], name: str) -> None:
        """Prepare the thread.

        Args:
            run: What it does.
            name: Shown in tracebacks and by debuggers.
        """
        super().__init__(target=run, name=name, daemon=True)

    def join(self, timeout: float | None = None) -> None:
        """Wait until the thread has ended, or for some seconds; one without a start has."""
        until = time.monotonic() + _START_TIME
        while True:
            try:
                return super().join(timeout)
            except RuntimeError:  # it does not run yet
                if time.monotonic() > until:
                    if self.ident is None:
                        return None
                    raise
            time.sleep(_PAUSE)
