"""Frames: messages with a fixed header and a payload whose size is checked before it is read."""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple

from physx_core.errors import ConnectionRefusedByPeerError, UsageError
from physx_core.net.connection import Reader
from physx_core.net.link import Link

HEADER = struct.Struct("<IHHQ")
"""Length of the payload in bytes, kind, reserved (0), number."""

_BUFFER = 1 << 17
_DIRECT = 1 << 14
_STEP = 1 << 20

MAX_PAYLOAD = 1 << 30
"""Longest payload in bytes that an authenticated peer may send."""


class Kind(enum.IntEnum):
    """Kind of a frame; the meaning of ``number``, if it has one, is in brackets."""

    HELLO = 1
    """Client: magic, version, challenge."""
    CHALLENGE = 2
    """Server: magic, version, challenge, proof [1: no proof before the connection is encrypted]."""
    PROOF = 3
    """Client: proof [number of the instance to run, 0: any]."""
    SETUP = 4
    """Server: the arguments of the instance."""
    READY = 5
    """Client: the environment is ready; its fields, whose shapes may still be undefined [1: its
    episodes are independent]."""
    FIELDS = 6
    """Client: the fields with the shapes of the first sample."""
    CREDIT = 7
    """Server: permission to generate rows [their total number since the start]."""
    ROWS = 8
    """Client: a block of rows, column by column [number of rows]."""
    PREDICT = 9
    """Client: request for the prediction of one sample [number of the request]."""
    SAVE = 10
    """Client: request to save parameters [number of the request]."""
    LOAD = 11
    """Client: request for the saved parameters [number of the request]."""
    ANSWER = 12
    """Server: answer to a request [number of the request]."""
    REFUSAL = 13
    """Server: error of a failed request [number of the request]."""
    SHOW = 14
    """Client: drawing events [step]."""
    APPLY = 15
    """Server: predictions for the environment [number of rows]."""
    ERROR = 16
    """Either: an error that ends the client [row that could not be generated, 0: no row]."""
    CLOSE = 17
    """Server: order to close the environment and exit."""
    BYE = 18
    """Client: the environment is closed, or the client leaves the run."""
    STORED = 19
    """Server: stored rows from which to generate the next rows [number of rows]."""
    WRONG = 20
    """Client: rows that `check_sample` rejected, before the next accepted ones [their number]."""
    REQUEST = 22
    """Client of a served environment: a request [number of the request]."""
    ACTIONS = 23
    """Client of a served environment: actions of its worlds [number of the request]."""
    NOTES = 24
    """Server: values without a fixed layout that belong to the next message [as there]."""
    SEEN = 25
    """Server: the result of a request, for observing clients [number of results so far]."""
    PARAMETERS = 26
    """Client, before READY: the parameters that its environment defines, if any."""
    CHOOSE = 27
    """Client: request for the parameters of an episode [number of the request]."""
    PING = 28
    """Client: it is alive, though it has nothing to send."""
    FOLDER = 29
    """Client that writes partitions: what it read in the dataset's folder."""
    PARTITION = 30
    """Client: request for a partition to write rows to. Server: the partition."""
    WRITTEN = 31
    """Client, instead of ROWS: rows are in its partitions [address of the first one]."""
    SEALED = 33
    """Client: a full partition is sealed; its checksums [its number]."""
    LEASE = 34
    """Server: numbers of episodes to simulate, with their parameters [how many]."""
    EPISODES = 35
    """Client: what became of episodes, after their rows [number of these rows]."""
    STATE = 36
    """Client: its state before its next row [number of rows so far; 0: why there can be none]."""

    TOUCH = 37
    """Client: request for what a person does to its environment [number of the request]."""


_KINDS = {int(kind): kind for kind in Kind}


class Frame(NamedTuple):
    """One message.

    Attributes:
        kind: Its kind.
        number: A number whose meaning depends on the kind.
        payload: Its content, in a separate buffer.
    """

    kind: Kind
    number: int
    payload: bytearray


def pack(kind: Kind, payload: bytes = b"", number: int = 0) -> bytes:
    """Return a message as the bytes to send.

    Raises:
        UsageError: If the payload is longer than a frame may be.
    """
    return pack_header(kind, len(payload), number) + payload


def pack_header(kind: Kind, length: int, number: int = 0) -> bytes:
    """Return the header of a message whose payload has `length` bytes.

    Raises:
        UsageError: If the payload is longer than a frame may be.
    """
    if length > MAX_PAYLOAD:
        raise UsageError(
            f"A message ({kind.name}) of {length} bytes is too long: client and server exchange at "
            f"most {MAX_PAYLOAD} bytes per message. Pass large data in a file, or run with "
            "as_tcp_ip_client=False."
        )
    return HEADER.pack(length, kind, 0, number)


class FrameReader(Reader):
    """Reads frames from a blocking or non-blocking socket.

    One system call may read several frames into a buffer. The missing bytes of a long frame are
    read directly into its payload, which grows as they arrive, so that a peer that announces much
    but sends little takes little memory.
    """

    def __init__(self, limit: int) -> None:
        """Start before a header.

        Args:
            limit: Longest accepted payload in bytes.
        """
        self._limit = limit
        self._socket_may_have_more = False
        self._bytes = bytearray(min(HEADER.size + limit, _BUFFER))
        self._buffer = memoryview(self._bytes)
        self._start = self._end = 0
        self._large: _LargeFrame | None = None
        self._after_large = False

    @property
    def limit(self) -> int:
        """Longest accepted payload in bytes."""
        return self._limit

    @limit.setter
    def limit(self, limit: int) -> None:
        self._limit = limit
        size = max(self._end - self._start, min(HEADER.size + limit, _BUFFER))
        larger = bytearray(size)
        larger[: self._end - self._start] = self._buffer[self._start : self._end]
        self._start, self._end = 0, self._end - self._start
        self._bytes, self._buffer = larger, memoryview(larger)

    @property
    def has_buffered(self) -> bool:
        """Whether a complete frame has been received but not read."""
        waiting = self._end - self._start - HEADER.size
        if waiting < 0 or self._large is not None:
            return False
        return waiting >= int(HEADER.unpack_from(self._bytes, self._start)[0])

    @property
    def arrived(self) -> int:
        """Number of bytes of an unfinished long frame that have arrived; 0 if there is none."""
        return 0 if self._large is None else self._large.received

    @property
    def may_have_more(self) -> bool:
        """Whether another `read` may find data immediately; False: it certainly does not."""
        return self._socket_may_have_more or self.has_buffered

    def read(self, connection: Link) -> Frame | None:
        """Return the next frame, or None if a non-blocking socket has no complete one yet.

        Raises:
            EOFError: If the peer is gone.
            ConnectionRefusedByPeerError: If the peer sent something that is not a frame, or a
                frame that is too long.
        """
        while True:
            frame = self.take()
            if frame is not None:
                return frame
            try:
                count = self.receive(connection)
            except BlockingIOError:
                return None
            except OSError as error:
                raise EOFError(str(error)) from error
            if not count:
                raise EOFError("end of stream")

    def take(self) -> Frame | None:
        """Return the next complete frame, or None until more has arrived.

        Raises:
            ConnectionRefusedByPeerError: If the peer sent something that is not a frame, or a
                frame that is too long.
        """
        if self._large is not None:
            if self._large.missing:
                return None
            frame, self._large = self._large.frame, None
            return frame
        return self._buffered() if self._start < self._end else None

    def receive(self, connection: Link) -> int:
        """Receive available bytes and return their number; 0 at the end of the stream.

        Raises:
            BlockingIOError: If nothing has arrived.
            OSError: If the connection is broken.
        """
        target = self._room()
        count = connection.recv_into(target)
        self._socket_may_have_more = count == len(target)
        if self._large is None:
            self._end += count
        else:
            self._large.filled(target, count)
        return count

    @property
    def waiting(self) -> int:
        """Number of bytes that have been received but not taken."""
        return self._end - self._start + self.arrived

    @property
    def has_room(self) -> bool:
        """Whether more can be received before a frame is taken."""
        if self._large is not None:
            return self._large.missing > 0
        return self._end - self._start < len(self._bytes)

    def _buffered(self) -> Frame | None:
        """Return the frame at the start of the buffer if it is complete; begin a long one."""
        start = self._start + HEADER.size
        if start > self._end:
            return None
        length, kind, spare, number = HEADER.unpack_from(self._bytes, self._start)
        known = _KINDS.get(kind)
        if length > self._limit or spare or known is None:
            raise ConnectionRefusedByPeerError(
                "The peer of a connection sent something that is not a physx message, or a message "
                f"longer than the {self._limit} bytes accepted here."
            )
        end = start + length
        if end <= self._end:
            self._start, self._after_large = end, False
            return Frame(known, number, self._bytes[start:end])
        if length > _DIRECT:
            self._large = _LargeFrame(known, number, length)
            self._large.put(self._buffer[start : self._end])
            self._start, self._end, self._after_large = 0, 0, True
        return None

    def _room(self) -> memoryview:
        """Return the buffer for the next bytes."""
        if self._large is not None:
            return self._large.room()
        waiting = self._end - self._start
        if self._start:
            if waiting:
                self._bytes[:waiting] = self._bytes[self._start : self._end]
            self._start, self._end = 0, waiting
        if self._after_large:  # another long frame is likely: read little more than its header
            return self._buffer[waiting : max(_DIRECT, waiting + HEADER.size)]
        return self._buffer[waiting:] if waiting else self._buffer


class _LargeFrame:
    """A long frame that has not arrived completely.

    Attributes:
        frame: The frame.
        received: Number of bytes of its payload that have arrived.
        missing: Number of bytes that have not arrived.
    """

    def __init__(self, kind: Kind, number: int, length: int) -> None:
        self.frame = Frame(kind, number, bytearray(min(length, _STEP)))
        self.missing = length
        self.received = 0

    def put(self, data: memoryview) -> None:
        """Append bytes received into another buffer."""
        self.frame.payload[: len(data)] = data
        self.received += len(data)
        self.missing -= len(data)

    def room(self) -> memoryview:
        """Return the buffer for the next bytes."""
        payload = self.frame.payload
        if self.received == len(payload):
            payload += bytes(min(self.missing, len(payload)))
        return memoryview(payload)[self.received :]

    def filled(self, room: memoryview, count: int) -> None:
        """Count the bytes received into `room`."""
        room.release()
        self.received += count
        self.missing -= count
