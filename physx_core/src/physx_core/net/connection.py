"""Connection: a server's end of one connection, with its incoming and outgoing data."""

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
    """Splits the byte stream of a socket into messages."""

    @abstractmethod
    def receive(self, connection: socket.socket) -> int:
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
    """One non-blocking socket of a server.

    Attributes:
        socket: The socket.
        reader: Splits the incoming bytes into messages.
        name: The peer as ``host:port``, for log and error messages.
        heard: When something was last received from the peer or sent to it, in monotonic s.
        closed: Whether the socket is closed.
        outgoing: Bytes waiting to be sent.
        events: The events that the selector watches for.
    """

    def __init__(self, connected: socket.socket, reader: Reader, name: str = "") -> None:
        """Take a connected socket.

        Args:
            connected: The socket.
            reader: Splits the incoming bytes into messages.
            name: The peer, for log and error messages.
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
        """Send parts as one message, as far as possible now; `flush` sends the rest.

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
        """Send waiting bytes, as far as possible now, and return the number of bytes sent.

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
            selector.unregister(self.socket)
        elif not self.events:
            selector.register(self.socket, events, self)
        else:
            selector.modify(self.socket, events, self)
        self.events = events

    def close(self) -> None:
        """Unregister and close the socket."""
        self.closed = True
        if self.events and self._selector is not None:
            self._selector.unregister(self.socket)
        self.events, self._selector = 0, None
        self.socket.close()
