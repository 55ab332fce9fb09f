"""Connection: one socket of a service, what has arrived on it and what waits to be sent."""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import time
from collections.abc import Sequence

from physx_core.errors import RemoteError
from physx_remote.serving.framing import Reader

MOMENT = 100e-6
"""How long to look for the next message of a client that is quick, in s."""

_QUICK = 2 * MOMENT
_PIECE = 1 << 16
_UNREAD = 1 << 20


def listening_socket(address: str, port: int) -> socket.socket:
    """Return a socket that listens and does not block.

    Args:
        address: Address of this machine.
        port: Port, 0 for any that is free.

    Raises:
        RemoteError: The address is not one of this machine, or the port is in use.
    """
    try:
        found = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)
        family, place = found[0][0], found[0][4]
        listener = socket.create_server(place, family=family, backlog=128)
    except (OSError, OverflowError, UnicodeError, TypeError) as error:
        raise RemoteError(
            f"Nothing can be served at {address} port {port}: {error}. Choose port 0 for any "
            "free port, or an address of this machine; one that another program uses is taken."
        ) from error
    listener.setblocking(False)
    return listener


class Connection:
    """One socket that does not block.

    Attributes:
        socket: The socket.
        reader: Cuts what arrives into bodies.
        name: The other side as ``host:port``, for messages to people.
        body: The next body to be handled, None for none yet.
        heard: When the other side last sent something or was answered, in monotonic s.
        is_quick: Whether the other side sent its last message soon after the answer before.
        ended: Whether the other side sends no more.
        closed: Whether the socket is closed.
        events: What the service's selector looks for.
        outgoing: What waits to be sent.
    """

    def __init__(self, connection: socket.socket, reader: Reader, name: str) -> None:
        """Take a new connection.

        Args:
            connection: The socket.
            reader: Cuts what arrives into bodies.
            name: The other side, for messages to people.
        """
        connection.setblocking(False)
        with contextlib.suppress(OSError):  # a socket that is not TCP has no such option
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.socket, self.reader, self.name = connection, reader, name
        self.body: bytes | None = None
        self.heard = self._begun = time.monotonic()
        self.ended = self.closed = self.is_quick = False
        self.events = 0
        self.outgoing = bytearray()

    @property
    def unsent(self) -> int:
        """How many bytes wait to be sent."""
        return len(self.outgoing)

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to do now."""
        return self.body is None and not (self.reader.buffer or self.outgoing or self.ended)

    @property
    def silence(self) -> float:
        """For how long the other side has sent nothing, in s."""
        return time.monotonic() - self.heard

    @property
    def age(self) -> float:
        """For how long it has been connected, in s."""
        return time.monotonic() - self._begun

    def limit_backlog(self, size: int) -> None:
        """Have the system keep no more than about so many bytes that the other side has not read.

        Args:
            size: How many bytes.
        """
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size)

    def touch(self) -> None:
        """Let the time of silence begin now: the other side had to wait until here."""
        self.heard = time.monotonic()

    @property
    def wants_more(self) -> bool:
        """Whether to read on: who sends faster than it is served has to wait."""
        return not self.ended and (self.body is None or self.reader.waiting < _UNREAD)

    def receive(self) -> bool:
        """Take what has arrived; return whether it was anything, be it the end.

        Raises:
            OSError: The connection is broken.
        """
        try:
            data = self.socket.recv(_PIECE)
        except BlockingIOError:
            return False
        self.ended = not data
        if data:
            now = time.monotonic()
            self.is_quick, self.heard = now - self.heard < _QUICK, now
            self.reader.feed(data)
        return True

    def receive_soon(self) -> bool:
        """Take what arrives within a moment; return whether it was anything, be it the end.

        For so short a time it is faster to look again and again than to be woken by the system.

        Raises:
            OSError: The connection is broken.
        """
        until = time.monotonic() + MOMENT
        while not self.receive():
            if time.monotonic() > until:
                return False
            _give_way()
        return True

    def next_body(self) -> bool:
        """Put the next whole message into `body`; return whether there is one.

        Raises:
            RemoteProtocolError: What has arrived is no message.
        """
        if self.body is None:
            self.body = self.reader.take()
        return self.body is not None

    def send(self, parts: Sequence[bytes | memoryview]) -> None:
        """Send the parts in one piece, as much as the connection takes now; `flush` sends the rest.

        Raises:
            OSError: The connection is broken.
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

    def flush(self) -> None:
        """Send what waits, as far as the connection takes it.

        Raises:
            OSError: The connection is broken.
        """
        sent = 0
        with contextlib.suppress(BlockingIOError), memoryview(self.outgoing) as waiting:
            sent = self.socket.send(waiting[:_UNREAD])
        del self.outgoing[:sent]

    def watch(self, selector: selectors.BaseSelector) -> None:
        """Have a selector look for what matters now."""
        events = selectors.EVENT_READ * self.wants_more
        events |= selectors.EVENT_WRITE * bool(self.outgoing)
        if events == self.events:
            return
        if not events:
            selector.unregister(self.socket)
        elif not self.events:
            selector.register(self.socket, events, self)
        else:
            selector.modify(self.socket, events, self)
        self.events = events

    def close(self, selector: selectors.BaseSelector) -> None:
        """Close the socket, which the selector looks at no longer."""
        self.closed = True
        if self.events:
            selector.unregister(self.socket)
        self.socket.close()


def _give_way() -> None:
    """Let another process that waits for this processor core go on."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()
