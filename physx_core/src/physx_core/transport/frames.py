"""Frames: every message is a fixed header and a payload whose size is checked before it is read."""

from __future__ import annotations

import enum
import socket
import struct
from dataclasses import dataclass

from physx_core.errors import ConnectionRefusedByPeerError, UsageError

HEADER = struct.Struct("<IHHQ")
"""Length of the payload in bytes, kind, spare (0), number."""

_BUFFER = 1 << 15

MAX_PAYLOAD = 1 << 30
"""Longest payload in bytes that an authenticated peer may send."""


class Kind(enum.IntEnum):
    """What a frame says; `number` is named in brackets where it has a meaning."""

    HELLO = 1
    """Client: magic, version, challenge."""
    CHALLENGE = 2
    """Server: magic, version, challenge, proof."""
    PROOF = 3
    """Client: proof [instance it wants to run, 0: any]."""
    SETUP = 4
    """Server: what the instance is made from."""
    READY = 5
    """Client: the environment lives; its fields, shapes may be open."""
    FIELDS = 6
    """Client: the fields as the first sample has them."""
    CREDIT = 7
    """Server: rows may be made [how many since the beginning]."""
    ROWS = 8
    """Client: a block of rows, column by column [how many]."""
    PREDICT = 9
    """Client: wants a prediction for one sample [number of the request]."""
    SAVE = 10
    """Client: wants parameters to be kept [number of the request]."""
    LOAD = 11
    """Client: wants the parameters that were kept [number of the request]."""
    ANSWER = 12
    """Server: answers a request [its number]."""
    REFUSAL = 13
    """Server: a request failed, with the error [its number]."""
    SHOW = 14
    """Client: drawing events [step]."""
    APPLY = 15
    """Server: predictions for the environment [how many]."""
    ERROR = 16
    """Either: an error that ends the client [row that could not be made, 0: none concerned]."""
    CLOSE = 17
    """Server: close the environment and end."""
    BYE = 18
    """Client: the environment is closed."""


_KINDS = frozenset(Kind)


@dataclass(frozen=True)
class Frame:
    """One message.

    Attributes:
        kind: What it says.
        number: A number whose meaning depends on the kind.
        payload: Its content; nobody else holds this buffer.
    """

    kind: Kind
    number: int
    payload: bytearray


def pack(kind: Kind, payload: bytes = b"", number: int = 0) -> bytes:
    """Return a message as the bytes to send.

    Raises:
        UsageError: The payload is longer than a frame may be.
    """
    return header(kind, len(payload), number) + payload


def header(kind: Kind, length: int, number: int = 0) -> bytes:
    """Return the header of a message whose payload has `length` bytes.

    Raises:
        UsageError: The payload is longer than a frame may be.
    """
    if length > MAX_PAYLOAD:
        raise UsageError(
            f"A message ({kind.name}) of {length} bytes is too long for one between client and "
            f"server, which takes {MAX_PAYLOAD}. Pass large data by file, or run with "
            "as_tcp_ip_client=False."
        )
    return HEADER.pack(length, kind, 0, number)


class FrameReader:
    """Reads frames from a socket, blocking or not.

    Small frames come several to a system call through a buffer; the bulk of a large one goes
    straight to its place.

    Attributes:
        limit: Longest payload in bytes that is taken.
    """

    def __init__(self, limit: int) -> None:
        """Begin in front of a header.

        Args:
            limit: Longest payload in bytes that is taken.
        """
        self.limit = limit
        self._socket_may_have_more = False
        self._buffer = memoryview(bytearray(_BUFFER))
        self._start = self._end = 0
        self._header = bytearray(HEADER.size)
        self._announced: Frame | None = None
        self._missing = memoryview(self._header)

    @property
    def has_buffered(self) -> bool:
        """Whether bytes that were received wait to be read."""
        return self._start < self._end

    @property
    def may_have_more(self) -> bool:
        """Whether another `read` may find something at once; False is certain."""
        return self.has_buffered or self._socket_may_have_more

    def read(self, connection: socket.socket) -> Frame | None:
        """Return the next frame, or None where a socket that does not block has no more for now.

        Raises:
            EOFError: The peer is gone.
            ConnectionRefusedByPeerError: The peer sent what is no frame, or too long a one.
        """
        while True:
            if self._missing and not self._receive(connection):
                return None
            if self._missing:
                continue
            if self._announced is None:
                self._announced = self._parsed()
                self._missing = memoryview(self._announced.payload)
            else:
                frame, self._announced = self._announced, None
                self._missing = memoryview(self._header)
                return frame

    def _receive(self, connection: socket.socket) -> bool:
        """Fill some of what is missing; return False where nothing is there."""
        if self._start == self._end:
            direct = len(self._missing) >= len(self._buffer)
            target = self._missing if direct else self._buffer
            try:
                count = connection.recv_into(target)
            except BlockingIOError:
                return False
            except OSError as error:
                raise EOFError(str(error)) from error
            if not count:
                raise EOFError("end of stream")
            self._socket_may_have_more = count == len(target)
            if direct:
                self._missing = self._missing[count:]
                return True
            self._start, self._end = 0, count
        count = min(len(self._missing), self._end - self._start)
        self._missing[:count] = self._buffer[self._start : self._start + count]
        self._missing = self._missing[count:]
        self._start += count
        return True

    def _parsed(self) -> Frame:
        length, kind, spare, number = HEADER.unpack(self._header)
        if length > self.limit or spare or kind not in _KINDS:
            raise ConnectionRefusedByPeerError(
                "The other side of a connection sent what is no message of physx, or one longer "
                f"than the {self.limit} bytes that are taken here."
            )
        return Frame(Kind(kind), number, bytearray(length))
