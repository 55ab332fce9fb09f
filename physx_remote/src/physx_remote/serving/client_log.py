"""ClientLog: what clients do, in the log; who does much cannot fill it."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any

from physx_remote.serving.service import LOG

_PERIOD = 10.0
_MOST = 20


class ClientLog:
    """Logs at most 20 entries of a level in 10 s about a host, and how many were left out."""

    def __init__(self, after: Callable[[float, Callable[[], None]], None]) -> None:
        """Start with nothing logged.

        Args:
            after: Calls a function so many seconds later.
        """
        self._after = after
        self._counts: Counter[tuple[int, str]] = Counter()

    def info(self, client: str, text: str, *args: Any) -> None:
        """Log what a client did; see `log`."""
        self.log(logging.INFO, client, text, *args)

    def warning(self, client: str, text: str, *args: Any) -> None:
        """Log that a client did something unusual; see `log`."""
        self.log(logging.WARNING, client, text, *args)

    def error(self, client: str, text: str, *args: Any, cause: BaseException | None = None) -> None:
        """Log that a request of a client failed; see `log`."""
        self.log(logging.ERROR, client, text, *args, cause=cause)

    def log(
        self, level: int, client: str, text: str, *args: Any, cause: BaseException | None = None
    ) -> None:
        """Make an entry about a client, unless there are many about its host.

        Args:
            level: Level of the entry.
            client: The client as ``host:port``.
            text: The entry, with a place for each of `args`.
            args: Parts of the entry.
            cause: Exception whose traceback to log, too.
        """
        if not LOG.isEnabledFor(level):
            return
        if not self._counts:
            self._after(_PERIOD, self.summarize)
        key = level, client.rpartition(":")[0]
        self._counts[key] += 1
        if self._counts[key] <= _MOST:
            LOG.log(level, text, *args, exc_info=cause)

    def summarize(self) -> None:
        """Log how many entries were left out since the last time."""
        counts, self._counts = self._counts, Counter()
        for (level, host), count in counts.items():
            if count > _MOST:
                LOG.log(level, "%d more entries like these about %s", count - _MOST, host)
