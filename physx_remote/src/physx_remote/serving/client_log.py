"""ClientLog: logs what clients do; a busy client cannot flood the log."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any

from physx_remote.serving.service import LOG

_PERIOD = 10.0
_MOST = 20


class ClientLog:
    """Logs at most 20 entries per level and host in 10 s, and how many entries were suppressed."""

    def __init__(self, after: Callable[[float, Callable[[], None]], None]) -> None:
        """Start with an empty log.

        Args:
            after: Calls a function after a time in s.
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
        """Log that a client's request failed; see `log`."""
        self.log(logging.ERROR, client, text, *args, cause=cause)

    def log(
        self, level: int, client: str, text: str, *args: Any, cause: BaseException | None = None
    ) -> None:
        """Log an entry about a client, unless there are too many about its host.

        Args:
            level: Level of the entry.
            client: The client as ``host:port``.
            text: The entry, with placeholders for `args`.
            args: Values of the placeholders.
            cause: Exception whose traceback is logged too.
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
        """Log how many entries were suppressed since the last summary."""
        counts, self._counts = self._counts, Counter()
        for (level, host), count in counts.items():
            if count > _MOST:
                LOG.log(level, "%d more entries like these about %s", count - _MOST, host)
