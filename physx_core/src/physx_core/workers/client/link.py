"""WorkerLink: a client's end of the connection to its server."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import threading
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from typing import Any

from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.fields import Field
from physx_core.net.frames import Frame, FrameReader, Kind, pack
from physx_core.net.link import SOCKETS, Link, Transport
from physx_core.net.liveness import poll_peer
from physx_core.net.remote_errors import decode_error
from physx_core.net.values import decode, encode, pack_value
from physx_core.processes import BackgroundThread, kill_descendants

_SPIN_TIME = 2e-4
_CLEANUP_TIME = 1.0
_REST = 1 << 16
_MOST_PARTS = 512  # a system call takes at most 1024
_HANGUP = getattr(select, "POLLRDHUP", 0)


class RunEnded(BaseException):
    """The server ended the run, or is gone: unwinds the environment's step."""


class ServerGone(RunEnded):
    """The connection to the server has ended."""


class WorkerLink:
    """Authenticated, blocking connection to the server.

    Attributes:
        clock: The clock that the client follows.
        spins: Whether to spin-wait for an answer for up to 0.2 ms.
        heartbeat: How often to tell the server, while `beat` is in effect, that this process is
            alive, in s; None: never.
        requests: How many requests this client sent, with those before the state that it began
            with.
    """

    def __init__(
        self, connection: Link, reader: FrameReader, transport: Transport = SOCKETS
    ) -> None:
        """Take over a connection whose handshake is done.

        Args:
            connection: The link.
            reader: The reader that the handshake returned.
            transport: What the link belongs to.
        """
        self.clock, self.spins = transport.clock, False
        self.heartbeat: float | None = None
        self._transport = transport
        self._sending = threading.Lock()
        self._connection = connection
        self._reader = reader
        self._buffered: Collection[Any] = getattr(connection, "buffered", ())  # see SecureSocket
        self._postponed: deque[Frame] = deque()
        self.requests = 0
        self._poll = transport.poll(connection)
        self._over = threading.Event()

    def exit_if_lost(self) -> None:
        """Watch the connection in a thread that ends this process if the server is gone.

        It does within about a second, even during a long step, and within about 15 s if the
        server's machine no longer answers.
        """
        BackgroundThread(self._watch, "physx-orders").start()

    def beat(self) -> None:
        """Send signs of life from now on, in a thread, also during a long step."""
        if self.heartbeat is not None:
            BackgroundThread(self._beat, "physx-heartbeat").start()

    def send(self, message: bytes) -> None:
        """Send a message."""
        try:
            with self._sending:
                self._connection.sendall(message)
        except OSError as error:
            raise ServerGone from error

    def send_parts(self, parts: Sequence[bytes | memoryview]) -> None:
        """Send a message that is given in parts.

        Args:
            parts: The bytes, in order; they may change once this returns.
        """
        waiting = [memoryview(part) for part in parts if len(part)]
        try:
            with self._sending:
                while waiting:
                    sent = self._connection.sendmsg(waiting[:_MOST_PARTS])
                    while waiting and sent >= len(waiting[0]):
                        sent -= len(waiting.pop(0))
                    if sent:
                        waiting[0] = waiting[0][sent:]
        except OSError as error:
            raise ServerGone from error

    def receive(self) -> Frame:
        """Wait for the next message."""
        self._spin()
        return self._postponed.popleft() if self._postponed else self._next()

    def put_back(self, frame: Frame) -> None:
        """Put back a message that arrived too early: `receive` returns it again."""
        self._postponed.appendleft(frame)

    def has_message(self) -> bool:
        """Return whether `receive` would find a message at once."""
        if self._postponed or self._reader.has_buffered or self._buffered:
            return True
        return bool(self._poll.poll(0))

    def skip(self, frame: Frame) -> None:
        """Handle a message that orders nothing: the end of the run, or a late answer.

        Raises:
            RunEnded: If it ends the run.
            ConnectionRefusedByPeerError: If only a client sends such messages.
        """
        if frame.kind is Kind.CLOSE:
            raise RunEnded
        if frame.kind not in (Kind.ANSWER, Kind.REFUSAL):  # to an abandoned request
            raise ConnectionRefusedByPeerError(
                f"The server sent {frame.kind.name}, which only a client sends."
            )

    def tell_fields(self, fields: Iterable[Field]) -> None:
        """Send the fields of the rows that follow."""
        self.send(pack(Kind.FIELDS, encode([field.to_dict() for field in fields])))

    def ask(self, kind: Kind, value: Any, what: str) -> Any:
        """Send a request and wait for the answer.

        Args:
            kind: Kind of the request.
            value: Its value.
            what: Name of the value for error messages.

        Returns:
            The value of the answer.
        """
        message = pack_value(kind, value, what, self.requests + 1)
        self.requests += 1
        self.send(message)
        self._spin()
        while True:
            frame = self._next()
            if frame.kind is Kind.CLOSE:
                raise RunEnded
            if frame.kind not in (Kind.ANSWER, Kind.REFUSAL):
                self._postponed.append(frame)
            elif frame.number == self.requests:
                if frame.kind is Kind.REFUSAL:
                    raise decode_error(frame.payload)
                return decode(frame.payload)

    def finish(self) -> None:
        """Wait until the server has read all that was sent and has closed the connection.

        Unsent data is lost if a socket is closed while the other side sends to it.
        """
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)
            while self._connection.recv(_REST):
                pass

    def close(self) -> None:
        """Close the connection."""
        self._over.set()
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()

    def _spin(self) -> None:
        if self.spins:
            self._transport.spin_until(self.has_message, _SPIN_TIME)

    def _next(self) -> Frame:
        try:
            frame = self._reader.read(self._connection)
        except (EOFError, OSError) as error:
            raise ServerGone from error
        if frame is None:  # does not happen with a blocking socket
            raise ServerGone
        return frame

    def _beat(self) -> None:
        with contextlib.suppress(ServerGone):
            while not self._over.wait(self.heartbeat):
                self.send(pack(Kind.PING))

    def _watch(self) -> None:
        try:
            poll_peer(self._transport.poll(self._connection, _HANGUP), self._connection, None)
        except TimeoutError:
            with contextlib.suppress(OSError):  # unblock a call that sends or receives
                self._connection.shutdown(socket.SHUT_RDWR)
        if self._over.wait(_CLEANUP_TIME):
            return
        if os.getsid(0) == os.getpid():  # it was launched, with its own process group
            os.killpg(os.getpid(), signal.SIGKILL)
        kill_descendants()
        os._exit(1)
