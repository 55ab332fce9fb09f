"""Connection: a server's end of one connection, with what has arrived and what is to be sent."""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from abc import ABC, abstractmethod
from typing import Any

from physx_core.closeable import Closeable
from physx_core.net.liveness import prepare_connection

_MOST_AT_ONCE = 1 << 20


class Reader(ABC):
    """Cuts messages out of the stream of bytes that arrives on a socket."""

    @abstractmethod
    def receive(self, connection: socket.socket) -> int:
        """Take what has arrived and return how many bytes it is, 0 at the end of the stream.

        Raises:
            BlockingIOError: If nothing has arrived.
            OSError: If the connection is broken.
        """

    @abstractmethod
    def take(self) -> Any:
        """Return the next whole message, or None until more has arrived.

        Raises:
            PhysxError: If the bytes are not a message, or one that is too long. The stream cannot
                be read any further.
        """

    @property
    @abstractmethod
    def waiting(self) -> int:
        """How many bytes have arrived and were not taken."""

    @property
    @abstractmethod
    def has_room(self) -> bool:
        """Whether more may be received before a message is taken."""


class Connection(Closeable):
    """One non-blocking socket of a server.

    Attributes:
        socket: The socket.
        reader: Cuts what arrives into messages.
        name: The other side as ``host:port``, for messages to people.
        heard: When the other side last sent or was sent something, in monotonic s.
        closed: Whether the socket is closed.
        outgoing: Bytes that wait to be sent.
        events: The events that the selector watches for.
    """

    def __init__(self, connected: socket.socket, reader: Reader, name: str = "") -> None:
        """Take a connected socket.

        Args:
            connected: The socket.
            reader: Cuts what arrives into messages.
            name: The other side, for messages to people.
        """
        connected.setblocking(False)
        prepare_connection(connected)
        self.socket, self.reader, self.name = connected, reader, name
        self.heard = time.monotonic()
        self.closed = False
        self.outgoing = bytearray()
        self.events = 0
        self._selector: selectors.BaseSelector | None = None

    @property
    def wants_more(self) -> bool:
        """Whether to receive more now."""
        return True

    def write(self, *parts: bytes | memoryview) -> None:
        """Send parts as one piece, as much as the connection takes now; `flush` sends the rest.

        Raises:
            OSError: If the connection is broken.
        """
        sent = 0
        if not self.outgoing:
            try:
                sent = self.socket.send(parts[0]) if len(parts) == 1 else self.socket.sendmsg(parts)
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
        """Send what waits, as far as the connection takes it, and return how many bytes it took.

        Raises:
            OSError: If the connection is broken.
        """
        sent = 0
        with contextlib.suppress(BlockingIOError), memoryview(self.outgoing) as waiting:
            sent = self.socket.send(waiting[:_MOST_AT_ONCE])
        del self.outgoing[:sent]
        self.watch()
        return sent

    def attach(self, selector: selectors.BaseSelector) -> None:
        """Have a selector watch the connection from now on."""
        self._selector = selector
        self.watch()

    def watch(self) -> None:
        """Have the selector watch for the events that matter now."""
        events = selectors.EVENT_READ * self.wants_more
        events |= selectors.EVENT_WRITE * bool(self.outgoing)
        selector = self._selector
        if events == self.events or selector is None:
            return
        if not events:
            selector.unregister(self.socket)
        elif not self.events:
            selector.register(self.socket, events, self)
        else:
            selector.modify(self.socket, events, self)
        self.events = events

    def close(self) -> None:
        """Close the socket, which the selector watches no longer."""
        self.closed = True
        if self.events and self._selector is not None:
            self._selector.unregister(self.socket)
        self.events, self._selector = 0, None
        self.socket.close()
