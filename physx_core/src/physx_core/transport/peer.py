"""Peer: one connection of the server, a stranger until the handshake is done."""

from __future__ import annotations

import contextlib
import socket
import time

from physx_core.errors import PhysxError
from physx_core.fields import Field
from physx_core.transport.frames import FrameReader
from physx_core.transport.handshake import HANDSHAKE_LIMIT, ServerHandshake
from physx_core.transport.rows import RowQueue


class Peer:
    """What the server knows about one connection.

    Attributes:
        connection: The socket; it does not block.
        reader: Reads its frames.
        handshake: The handshake; None once the peer is trusted.
        heard: When the peer last sent something or was last sent something, in monotonic s.
        instance_id: Number of its instance, counted from 1; 0 while it is a stranger.
        fields: The environment's fields; empty before it is ready.
        row_fields: Fields of its rows, all shapes known; empty before the first sample.
        rows: Rows that arrived.
        received: How many rows arrived in all.
        granted: How many rows it may make in all.
        failure: The error that it sent.
        failed_row: Row, counted from 0, that the error kept it from making.
        finished: Whether it said that its environment is closed.
        gone: Whether the connection is at its end.
        awaits_room: Whether the server looks for the moment when more can be sent.
    """

    def __init__(self, connection: socket.socket, token: str) -> None:
        """Take a new connection.

        Args:
            connection: The socket.
            token: What the peer must know.
        """
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.connection = connection
        self.reader = FrameReader(HANDSHAKE_LIMIT)
        self.handshake: ServerHandshake | None = ServerHandshake(token)
        self.heard = time.monotonic()
        self.instance_id = 0
        self.fields: list[Field] = []
        self.row_fields: list[Field] = []
        self.rows = RowQueue()
        self.received = self.granted = 0
        self.failure: PhysxError | None = None
        self.failed_row = 0
        self.finished = self.gone = self.awaits_room = False
        self._outgoing = bytearray()

    @property
    def is_at_work(self) -> bool:
        """Whether its environment comes to life or makes rows."""
        if self.gone or self.finished or self.failure is not None:
            return False
        return not self.fields or self.received < self.granted

    @property
    def has_outgoing(self) -> bool:
        """Whether something waits to be sent."""
        return bool(self._outgoing)

    def send(self, message: bytes) -> None:
        """Send as much as the connection takes now; `flush` sends the rest."""
        if not self.gone:
            self._outgoing += message
            self.flush()
            self.heard = time.monotonic()  # its time to react begins now

    def flush(self) -> None:
        """Send what waits, as far as the connection takes it."""
        with contextlib.suppress(OSError):  # it takes no more now, or reading finds its end
            while self._outgoing:
                sent = self.connection.send(self._outgoing)
                del self._outgoing[:sent]
