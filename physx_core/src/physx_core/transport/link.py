"""Link: the client's end of the connection."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import threading
from collections import deque

from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.transport.failures import decode_error
from physx_core.transport.frames import Frame, FrameReader, Kind, pack
from physx_core.transport.handshake import introduce

_CONNECT_TIME = 10.0
_CLEANUP_TIME = 1.0
_HANGUP = getattr(select, "POLLRDHUP", 0)


class RunEnded(BaseException):
    """The server ended the run, or is gone: unwinds the environment's step."""


class Link:
    """Connection to the server, authenticated; blocking.

    A thread watches the connection: a process whose server is gone ends within about a second,
    even inside a long step.
    """

    def __init__(self, connection: socket.socket, reader: FrameReader) -> None:
        """Take a connection whose handshake is done.

        Args:
            connection: The socket.
            reader: The reader that the handshake left.
        """
        self._connection = connection
        self._reader = reader
        self._postponed: deque[Frame] = deque()
        self._requests = 0
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)
        self._over = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def send(self, message: bytes) -> None:
        """Send a message.

        Raises:
            RunEnded: The server is gone.
        """
        try:
            self._connection.sendall(message)
        except OSError as error:
            raise RunEnded from error

    def receive(self) -> Frame:
        """Wait for the next message.

        Raises:
            RunEnded: The server is gone.
        """
        return self._postponed.popleft() if self._postponed else self._next()

    def has_message(self) -> bool:
        """Return whether `receive` would find a message at once."""
        return bool(self._postponed or self._reader.has_buffered or self._poll.poll(0))

    def ask(self, kind: Kind, payload: bytes) -> bytearray:
        """Send a request and wait for the answer.

        Raises:
            RunEnded: The server ended the run instead.
            PhysxError: The request was refused.
        """
        self._requests += 1
        self.send(pack(kind, payload, self._requests))
        while True:
            frame = self._next()
            if frame.kind is Kind.CLOSE:
                raise RunEnded
            if frame.kind not in (Kind.ANSWER, Kind.REFUSAL):
                self._postponed.append(frame)
            elif frame.number == self._requests:
                if frame.kind is Kind.REFUSAL:
                    raise decode_error(frame.payload)
                return frame.payload

    def close(self) -> None:
        """Close the connection."""
        self._over.set()
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    def _next(self) -> Frame:
        try:
            frame = self._reader.read(self._connection)
        except (EOFError, OSError) as error:
            raise RunEnded from error
        if frame is None:  # a blocking socket has no such case
            raise RunEnded
        return frame

    def _watch(self) -> None:
        poll = select.poll()
        poll.register(self._connection, _HANGUP)
        poll.poll()
        if self._over.wait(_CLEANUP_TIME):
            return
        if os.getpgrp() == os.getpid():  # a group of its own: what the environment started too
            os.killpg(os.getpid(), signal.SIGKILL)
        os._exit(1)


def connect(address: str, token: str, instance: int) -> Link:
    """Connect to a server.

    Args:
        address: ``HOST:PORT``.
        token: Token of the run.
        instance: Number of the instance to run, 0 for any that is free.

    Raises:
        ConnectionRefusedByPeerError: Nothing answers at the address, or not a server with this
            token.
    """
    host, _, port = address.rpartition(":")
    try:
        place = (host.strip("[]"), int(port))
        connection = socket.create_connection(place, timeout=_CONNECT_TIME)
    except (OSError, ValueError, OverflowError) as error:
        raise ConnectionRefusedByPeerError(
            f'No server can be reached at "{address}": {error}. Give the HOST:PORT at which the '
            "run listens."
        ) from error
    try:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        reader = introduce(connection, token, instance)
        connection.settimeout(None)
    except BaseException:
        connection.close()
        raise
    return Link(connection, reader)
