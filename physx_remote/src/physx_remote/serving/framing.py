"""Framing: each message is a 4-byte little-endian length prefix followed by its body."""

from __future__ import annotations

import struct

from physx_core.net import Link, Reader
from physx_remote.errors import RemoteProtocolError

PREFIX = struct.Struct("<I")
"""Length of the body in bytes."""

MAX_REQUEST = 1 << 24
"""Default for the longest body that a service accepts, in bytes."""

MAX_ANSWER = 1 << 28
"""Default for the longest body that a client accepts, in bytes."""

CHUNK_SIZE = 1 << 16
_MOST_UNREAD = 1 << 20


def add_prefix(body: bytes) -> bytes:
    """Return prefix and body as one piece: some clients read the prefix with a single call."""
    try:
        return PREFIX.pack(len(body)) + body
    except struct.error:
        raise RemoteProtocolError(
            f"A message of {len(body)} bytes is too long: its length must fit into 4 bytes."
        ) from None


class BufferReader(Reader):
    """Collects what arrives in one buffer.

    Attributes:
        buffer: What has arrived and was not taken yet.
    """

    def __init__(self) -> None:
        """Start with an empty buffer."""
        self.buffer = bytearray()

    def receive(self, connection: Link) -> int:
        """Take what has arrived; see `Reader.receive`."""
        data = connection.recv(CHUNK_SIZE)
        self.buffer += data
        return len(data)

    @property
    def waiting(self) -> int:
        """Number of bytes that have arrived and were not taken yet."""
        return len(self.buffer)

    @property
    def has_room(self) -> bool:
        """Whether more may be received before a message is taken."""
        return len(self.buffer) < _MOST_UNREAD


class PrefixReader(BufferReader):
    """Extracts prefixed bodies. Memory use depends on what has arrived, not on announced sizes."""

    def __init__(self, limit: int = MAX_REQUEST) -> None:
        """Start before a prefix.

        Args:
            limit: Longest accepted body in bytes.
        """
        super().__init__()
        self.limit = limit

    def take(self) -> bytes | None:
        """Return the next complete body; None if it has not arrived yet."""
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
