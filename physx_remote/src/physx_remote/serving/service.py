"""Service: environments served to other processes, one `poll` at a time."""

from __future__ import annotations

import contextlib
import logging
from abc import abstractmethod
from collections.abc import Callable

from physx_core import Closeable
from physx_core.processes import deferred_interrupt

LOG = logging.getLogger("physx.remote")
"""Log of all services."""

_PERIOD = 0.1
"""How often to check for a signal while nothing arrives, in s."""


class Service(Closeable):
    """Serves environments to other processes in calls of `poll`. A context manager.

    Attributes:
        address: Host and port at which it listens, or to which it is connected.
    """

    address: tuple[str, int]

    @abstractmethod
    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived.

        Args:
            timeout: Time in s to wait for something to arrive; None: forever.

        Returns:
            False once the service has ended: it was closed here, or by the other side if the
            protocol allows that.

        Raises:
            RemoteError: If it has ended because the only other side violated the protocol, or its
                machine no longer responds.
        """

    def run(self) -> None:
        """Serve until Ctrl-C, or until a signal handler or another thread calls `close`."""
        with contextlib.suppress(KeyboardInterrupt):
            poll_until_interrupted(self.poll)

    @abstractmethod
    def close(self) -> None:
        """Close all connections; calling it again does nothing."""


def poll_until_interrupted(poll: Callable[[float], bool]) -> None:
    """Call `poll` until it returns False, or until a signal arrives.

    An exception raised by a signal handler could be lost where Python ignores exceptions, as in a
    finalizer.

    Raises:
        KeyboardInterrupt: After Ctrl-C; immediately after a second one.
        Terminated: The same for SIGTERM.
    """
    with deferred_interrupt() as interrupt:
        while not interrupt and poll(_PERIOD):
            continue
    if interrupt:
        interrupt.end()
