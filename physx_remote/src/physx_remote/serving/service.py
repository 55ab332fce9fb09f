"""Service: environments served to other processes, one `poll` at a time."""

from __future__ import annotations

import logging
from abc import abstractmethod

from physx_core import Closeable

LOG = logging.getLogger("physx.remote")
"""Log of all services."""


class Service(Closeable):
    """Serves environments to other processes, in calls of `poll`. A context manager.

    Attributes:
        address: Host and port where it listens, or to which it is connected.
    """

    address: tuple[str, int]

    @abstractmethod
    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived.

        Args:
            timeout: How long to wait for something to arrive, in s; None: forever.

        Returns:
            False once the service has ended: closed here, or by the other side where the
            protocol says so.

        Raises:
            RemoteError: If it has ended because the only other side violated the protocol, or its
                machine no longer answers.
        """

    def run(self) -> None:
        """Serve until Ctrl-C, or until a signal handler or another thread calls `close`."""
        try:
            while self.poll(None):
                continue
        except KeyboardInterrupt:
            return

    @abstractmethod
    def close(self) -> None:
        """End all connections; calling it again does nothing."""
