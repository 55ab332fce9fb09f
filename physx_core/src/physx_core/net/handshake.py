"""Handshake: both sides prove that they know the token before any other message is read.

Each side sends 32 random bytes; the other answers with their HMAC-SHA256 under the token. The
token itself is never sent. If the connection is encrypted, the proofs also cover the fingerprint of
the server's certificate: see `tls`.
"""

from __future__ import annotations

import hmac
import secrets
import socket
import struct

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.errors import ConnectionRefusedByPeerError, SilentPeerError, UnansweredError
from physx_core.net.addresses import is_same_host
from physx_core.net.frames import MAX_PAYLOAD, Frame, FrameReader, Kind, pack
from physx_core.net.link import Link

TOKEN_VARIABLE = "PHYSX_TOKEN"
"""Environment variable that holds the token of a run."""

VERSION = 2
"""Version of the protocol between client and server."""

HANDSHAKE_LIMIT = 256
"""Longest payload in bytes accepted from a pending connection."""

_OPENING = struct.Struct("<8sI32s")
_MAGIC = b"physxtcp"
_PROOF_SIZE = 32
_NOT_PLAIN = 1


class PlainRefusedError(ConnectionRefusedByPeerError):
    """A server requires encryption although its address is on this machine.

    Something at that address forwards the connection to another machine.
    """


def _proof(
    token: str, side: bytes, first: bytes, second: bytes, channel: bytes, instance: int = 0
) -> bytes:
    message = b"|".join([side, struct.pack("<IQ", VERSION, instance), first, second, channel])
    return hmac.new(token.encode(), message, "sha256").digest()


class ServerHandshake:
    """The server's part of one handshake.

    Attributes:
        instance_id: Number of the instance that the client requests, 0 for any; None until it is
            trusted.
        since: When the server began to wait for the client, in monotonic s.
    """

    def __init__(self, token: str, clock: Clock = SYSTEM_CLOCK) -> None:
        """Draw a challenge.

        Args:
            token: The token that the client must know.
            clock: Tells `since`.
        """
        self.instance_id: int | None = None
        self._clock, self.since = clock, clock.monotonic()
        self._token = token
        self._own = secrets.token_bytes(32)
        self._other: bytes | None = None
        self._is_greeted = False

    def answer(self, frame: Frame, channel: bytes | None = b"") -> bytes:
        """Return the bytes to send back; `instance_id` is set once the client is trusted.

        Args:
            frame: The client's message.
            channel: See `SecureSocket.channel`.

        Raises:
            ConnectionRefusedByPeerError: If the client violated the protocol, or does not know the
                token.
        """
        if frame.kind is Kind.HELLO and not self._is_greeted:
            magic, version, other = _parse_opening(frame.payload)
            self.since, self._is_greeted = self._clock.monotonic(), True
            if magic != _MAGIC:
                raise ConnectionRefusedByPeerError("The peer is not a physx client.")
            opening = _OPENING.pack(_MAGIC, VERSION, self._own)
            if version != VERSION:  # the client now knows both versions and reports the mismatch
                return pack(Kind.CHALLENGE, opening + bytes(_PROOF_SIZE))
            if channel is None:
                return pack(Kind.CHALLENGE, opening + bytes(_PROOF_SIZE), _NOT_PLAIN)
            self._other = other
            proof = _proof(self._token, b"server", other, self._own, channel)
            return pack(Kind.CHALLENGE, opening + proof)
        if frame.kind is Kind.PROOF and self._other is not None and channel is not None:
            wanted = _proof(self._token, b"client", self._own, self._other, channel, frame.number)
            if hmac.compare_digest(wanted, bytes(frame.payload)):
                self.instance_id = frame.number
                return b""
        raise ConnectionRefusedByPeerError("The client does not know the token.")


def encrypt(connection: Link, *, always: bool = False) -> Link:
    """Return a client's connection ready for use: encrypted if it leaves this machine.

    Args:
        connection: Connected, blocking link, which is taken over if it is encrypted; its timeout
            covers the whole exchange.
        always: Whether to encrypt in any case because the server requires it.

    Raises:
        SilentPeerError: If the server does not answer in time.
        UnansweredError: If the server ended the connection.
        ConnectionRefusedByPeerError: If the server does not encrypt.
    """
    if not always and is_same_host(connection):
        return connection
    assert isinstance(connection, socket.socket)
    from physx_core.net.tls import SecureSocket  # takes a while to import

    older = (
        "If it belongs to physx, its version does not support encryption: install the same version "
        "of physx-core on both sides."
    )
    try:
        return SecureSocket.of_client(connection)
    except TimeoutError as error:
        raise SilentPeerError("The server did not answer in time.") from error
    except ConnectionAbortedError as error:
        raise ConnectionRefusedByPeerError(
            f"The server at that address does not use physx's encryption ({error}). {older}"
        ) from error
    except OSError as error:
        raise UnansweredError(f"The server ended the connection ({error}). {older}") from error


def introduce(
    connection: Link, token: str, instance: int, clock: Clock = SYSTEM_CLOCK
) -> FrameReader:
    """Prove to a server that this client knows the token, and verify that the server does.

    Args:
        connection: Blocking link returned by `encrypt`; its timeout covers the whole handshake.
        token: The run's token.
        instance: Number of the instance to run, 0 for any that is free.
        clock: The clock that the timeout follows.

    Returns:
        The reader of the connection.

    Raises:
        SilentPeerError: If the server does not answer in time.
        UnansweredError: If the server ended the connection.
        PlainRefusedError: If the server requires an encrypted connection.
        ConnectionRefusedByPeerError: If the server has another version or another token, or is
            not a physx server.
    """
    channel: bytes = getattr(connection, "channel", b"")
    reader = FrameReader(HANDSHAKE_LIMIT)
    own = secrets.token_bytes(32)
    try:
        connection.sendall(pack(Kind.HELLO, _OPENING.pack(_MAGIC, VERSION, own)))
        frame = _read_in_time(connection, reader, clock)
    except TimeoutError as error:
        raise SilentPeerError("The server did not answer in time.") from error
    except (EOFError, OSError) as error:
        raise UnansweredError(f"The server ended the connection ({error}).") from error
    if frame.kind is not Kind.CHALLENGE:
        raise ConnectionRefusedByPeerError("The peer at that address is not a physx server.")
    magic, version, other = _parse_opening(frame.payload[:-_PROOF_SIZE])
    if magic != _MAGIC or version != VERSION:
        raise ConnectionRefusedByPeerError(
            f"The server speaks version {version} of the protocol, this client version {VERSION}. "
            "Install the same version of physx-core on both sides."
        )
    if frame.number == _NOT_PLAIN and not channel:
        raise PlainRefusedError("The server accepts only encrypted connections from here.")
    if not hmac.compare_digest(
        _proof(token, b"server", own, other, channel), bytes(frame.payload[-_PROOF_SIZE:])
    ):
        raise ConnectionRefusedByPeerError(
            "The server does not know this client's token"
            + (", or someone in between answers in its place" if channel else "")
            + f". Set the environment variable {TOKEN_VARIABLE} to the token of the run to join, "
            "or name the file that holds it with --token-file."
        )
    proof = _proof(token, b"client", other, own, channel, instance)
    try:
        connection.sendall(pack(Kind.PROOF, proof, instance))
    except OSError as error:
        raise UnansweredError(f"The server ended the connection ({error}).") from error
    reader.limit = MAX_PAYLOAD
    return reader


def _read_in_time(connection: Link, reader: FrameReader, clock: Clock) -> Frame:
    """Return the next frame within the timeout, even if it arrives in pieces."""
    patience = connection.gettimeout()
    until = None if patience is None else clock.monotonic() + patience
    while (frame := reader.take()) is None:
        if until is not None:
            connection.settimeout(max(until - clock.monotonic(), 1e-3))
        if not reader.receive(connection):
            raise EOFError("end of stream")
    connection.settimeout(patience)
    return frame


def _parse_opening(payload: bytearray) -> tuple[bytes, int, bytes]:
    try:
        magic, version, challenge = _OPENING.unpack(payload)
    except struct.error:
        raise ConnectionRefusedByPeerError("The peer sent a malformed greeting.") from None
    return magic, version, challenge
