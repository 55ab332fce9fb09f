"""Connection: a server's end of one connection, with its incoming and outgoing data."""

from __future__ import annotations

import contextlib
import selectors
from abc import ABC, abstractmethod
from typing import Any

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.closeable import Closeable
from physx_core.net.link import Link
from physx_core.net.liveness import prepare_connection

_SEND_LIMIT = 1 << 20


class Reader(ABC):
    """Splits the byte stream of a link into messages."""

    @abstractmethod
    def receive(self, connection: Link) -> int:
        """Receive available bytes and return their number; 0 at the end of the stream.

        Raises:
            BlockingIOError: If nothing has arrived.
            OSError: If the connection is broken.
        """

    @abstractmethod
    def take(self) -> Any:
        """Return the next complete message, or None until more has arrived.

        Raises:
            PhysxError: If the bytes are not a message, or the message is too long. The stream is
                then unusable.
        """

    @property
    @abstractmethod
    def waiting(self) -> int:
        """Number of bytes that have been received but not taken."""

    @property
    @abstractmethod
    def has_room(self) -> bool:
        """Whether more can be received before a message is taken."""


class Connection(Closeable):
    """One non-blocking link of a server.

    Attributes:
        link: The link.
        reader: Splits the incoming bytes into messages.
        name: The peer as ``host:port``, for log and error messages.
        heard: When something was last received from the peer or sent to it, in monotonic s.
        closed: Whether the link is closed.
        outgoing: Bytes waiting to be sent.
        events: The events that the selector watches for.
    """

    def __init__(
        self, link: Link, reader: Reader, name: str = "", clock: Clock = SYSTEM_CLOCK
    ) -> None:
        """Take a connected link.

        Args:
            link: The link.
            reader: Splits the incoming bytes into messages.
            name: The peer, for log and error messages.
            clock: Tells when something was received or sent.
        """
        link.setblocking(False)
        prepare_connection(link)
        self.link, self.reader, self.name = link, reader, name
        self._clock = clock
        self.heard = clock.monotonic()
        self.closed = False
        self.outgoing = bytearray()
        self.events = 0
        self._selector: selectors.BaseSelector | None = None

    @property
    def wants_more(self) -> bool:
        """Whether to receive more now."""
        return True

    def write(self, *parts: bytes | memoryview) -> None:
        """Send parts as one message, as far as possible now; `flush` sends the rest.

        Raises:
            OSError: If the connection is broken.
        """
        sent = 0
        if not self.outgoing:
            try:
                sent = self.link.send(parts[0]) if len(parts) == 1 else self.link.sendmsg(parts)
            except BlockingIOError:
                sent = 0
            if len(parts) == 1 and sent == len(parts[0]):
                return
        for part in parts:
            size = len(part) if isinstance(part, bytes) else part.nbytes
            if sent < size:
                self.outgoing += memoryview(part).cast("B")[sent:]
                sent = 0
            else:
                sent -= size
        if self.outgoing:
            self.watch()

    def flush(self) -> int:
        """Send waiting bytes, as far as possible now, and return the number of bytes sent.

        Raises:
            OSError: If the connection is broken.
        """
        sent = 0
        with contextlib.suppress(BlockingIOError), memoryview(self.outgoing) as waiting:
            sent = self.link.send(waiting[:_SEND_LIMIT])
        del self.outgoing[:sent]
        self.watch()
        return sent

    def attach(self, selector: selectors.BaseSelector) -> None:
        """Register the connection with a selector."""
        self._selector = selector
        self.watch()

    def watch(self) -> None:
        """Make the selector watch for the events that matter now."""
        events = selectors.EVENT_READ * self.wants_more
        events |= selectors.EVENT_WRITE * bool(self.outgoing)
        selector = self._selector
        if events == self.events or selector is None:
            return
        if not events:
            selector.unregister(self.link)
        elif not self.events:
            selector.register(self.link, events, self)
        else:
            selector.modify(self.link, events, self)
        self.events = events

    def close(self) -> None:
        """Unregister and close the link."""
        self.closed = True
        if self.events and self._selector is not None:
            self._selector.unregister(self.link)
        self.events, self._selector = 0, None
        self.link.close()
