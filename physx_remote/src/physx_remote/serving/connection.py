"""RequestConnection: a service's connection, on which requests arrive."""

from __future__ import annotations

import socket
from typing import Any

from physx_core.net import Connection

SPIN_LIMIT = 100e-6
"""How long to poll for the next message of a quick client without sleeping, in s."""

_QUICK = 2 * SPIN_LIMIT


class RequestConnection(Connection):
    """A connection whose messages are handled one at a time.

    Attributes:
        body: The next message to handle; None if there is none yet.
        is_quick: Whether the client sent its last message soon after the previous answer.
        ended: Whether the client has stopped sending.
    """

    body: Any = None
    ended = is_quick = False

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to do now."""
        return self.body is None and not (self.reader.waiting or self.outgoing or self.ended)

    @property
    def silence(self) -> float:
        """Time in s since the client last sent something."""
        return self._clock.monotonic() - self.heard

    @property
    def wants_more(self) -> bool:
        """Whether to keep reading: a client that sends faster than it is served has to wait."""
        return not self.ended and (self.body is None or self.reader.has_room)

    def limit_backlog(self, size: int) -> None:
        """Limit the unread data that the system keeps for the client to about `size` bytes."""
        self.link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size)

    def touch(self) -> None:
        """Restart the time of silence, because the client had to wait until now."""
        self.heard = self._clock.monotonic()

    def receive(self) -> bool:
        """Take what has arrived; return whether there was anything, even the end of the stream.

        Raises:
            OSError: If the connection is broken.
        """
        try:
            count = self.reader.receive(self.link)
        except BlockingIOError:
            return False
        self.ended = not count
        if count:
            now = self._clock.monotonic()
            self.is_quick, self.heard = now - self.heard < _QUICK, now
        return True

    def next_body(self) -> bool:
        """Put the next complete message into `body`; return whether there is one.

        Raises:
            PhysxError: If what has arrived is not a valid message.
        """
        if self.body is None:
            self.body = self.reader.take()
        return self.body is not None
