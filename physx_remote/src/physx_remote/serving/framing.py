"""Framing: each message is its length, 4 bytes with the lowest first, and then its body."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod

from physx_core.errors import RemoteProtocolError

PREFIX = struct.Struct("<I")
"""Length of the body in bytes."""

MAX_REQUEST = 1 << 24
"""Longest body in bytes that a service takes unless told otherwise."""

MAX_ANSWER = 1 << 28
"""Longest body in bytes that a client takes unless told otherwise."""


def framed(body: bytes) -> bytes:
    """Return prefix and body as one piece: some clients read the prefix with one plain call.

    Raises:
        RemoteProtocolError: The body is longer than 4 bytes can tell.
    """
    try:
        return PREFIX.pack(len(body)) + body
    except struct.error:
        raise RemoteProtocolError(
            f"A message of {len(body)} bytes is too long: its length is told in 4 bytes."
        ) from None


class Reader(ABC):
    """Cuts bodies out of a stream that arrives in pieces of any size.

    Attributes:
        buffer: What has arrived and was not taken.
    """

    def __init__(self) -> None:
        self.buffer = bytearray()

    def feed(self, data: bytes) -> None:
        """Add what has arrived."""
        self.buffer += data

    @abstractmethod
    def take(self) -> bytes | None:
        """Return the next whole body, or None until more has arrived.

        Raises:
            RemoteProtocolError: What has arrived is no message, or one that is too long. The stream
                cannot be read on.
        """

    @property
    def waiting(self) -> int:
        """How many bytes have arrived and were not taken."""
        return len(self.buffer)


class FrameReader(Reader):
    """Cuts framed bodies; only what has arrived takes memory, whatever a prefix announces."""

    def __init__(self, limit: int = MAX_REQUEST) -> None:
        """Begin in front of a prefix.

        Args:
            limit: Longest body in bytes that is taken.
        """
        super().__init__()
        self.limit = limit

    def take(self) -> bytes | None:
        """Return the next whole body, or None until more has arrived.

        Raises:
            RemoteProtocolError: The next body is longer than the limit.
        """
        buffer = self.buffer
        if len(buffer) < PREFIX.size:
            return None
        (length,) = PREFIX.unpack_from(buffer)
        if length > self.limit:
            raise RemoteProtocolError(
                f"The other side announced a message of {length} bytes; at most {self.limit} are "
                "taken here."
            )
        end = PREFIX.size + length
        if len(buffer) < end:
            return None
        body = bytes(buffer[PREFIX.size : end])
        del buffer[:end]
        return body
