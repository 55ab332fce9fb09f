"""Framing: each message is a length prefix of 4 bytes, little-endian, and its body."""

from __future__ import annotations

import socket
import struct

from physx_core.errors import RemoteProtocolError
from physx_core.net import Reader

PREFIX = struct.Struct("<I")
"""Length of the body in bytes."""

MAX_REQUEST = 1 << 24
"""Longest body in bytes that a service accepts by default."""

MAX_ANSWER = 1 << 28
"""Longest body in bytes that a client accepts by default."""

_PIECE = 1 << 16
_MOST_UNREAD = 1 << 20


def add_prefix(body: bytes) -> bytes:
    """Return prefix and body as one piece: some clients read the prefix with one plain call."""
    try:
        return PREFIX.pack(len(body)) + body
    except struct.error:
        raise RemoteProtocolError(
            f"A message of {len(body)} bytes is too long: its length has to fit into 4 bytes."
        ) from None


class BufferReader(Reader):
    """Keeps what arrives in one buffer.

    Attributes:
        buffer: What has arrived and was not taken.
    """

    def __init__(self) -> None:
        """Start with nothing."""
        self.buffer = bytearray()

    def receive(self, connection: socket.socket) -> int:
        """Take what has arrived; see `Reader.receive`."""
        data = connection.recv(_PIECE)
        self.buffer += data
        return len(data)

    @property
    def waiting(self) -> int:
        """How many bytes have arrived and were not taken."""
        return len(self.buffer)

    @property
    def has_room(self) -> bool:
        """Whether more may be received before a message is taken."""
        return len(self.buffer) < _MOST_UNREAD


class PrefixReader(BufferReader):
    """Cuts bodies behind prefixes. Only what has arrived takes memory, whatever is announced."""

    def __init__(self, limit: int = MAX_REQUEST) -> None:
        """Start in front of a prefix.

        Args:
            limit: Longest body in bytes that is accepted.
        """
        super().__init__()
        self.limit = limit

    def take(self) -> bytes | None:
        """Return the next whole body, or None until more has arrived."""
        buffer = self.buffer
        if len(buffer) < PREFIX.size:
            return None
        (length,) = PREFIX.unpack_from(buffer)
        if length > self.limit:
            raise RemoteProtocolError(
                f"The other side announced a message of {length} bytes; at most {self.limit} are "
                "accepted here."
            )
        end = PREFIX.size + length
        if len(buffer) < end:
            return None
        body = bytes(buffer[PREFIX.size : end])
        del buffer[:end]
        return body
