"""PhysxLink: a client's authenticated connection with bounded waits."""

from __future__ import annotations

from typing import Any, ClassVar

from physx_core.errors import (
    ConfigError,
    ConnectionRefusedByPeerError,
    PhysxError,
    SilentPeerError,
    UnansweredError,
)
from physx_core.net import (
    SOCKETS,
    TOKEN_VARIABLE,
    Frame,
    FrameReader,
    Kind,
    PlainRefusedError,
    Transport,
    decode,
    decode_error,
    encrypt,
    find_token,
    introduce,
)
from physx_remote.errors import (
    RemoteClosedError,
    RemoteError,
    RemoteProtocolError,
    RemoteTimeoutError,
)
from physx_remote.physx.wire import OBSERVE, SERVICE, VERSION
from physx_remote.serving.client_connection import ClientConnection
from physx_remote.serving.framing import MAX_ANSWER

_BACKLOG = 1 << 16


class PhysxLink(ClientConnection):
    """A connection to a service of the protocol physx.

    It is closed after any failure, so a late answer is never mistaken for that of another request.

    Attributes:
        name: The service as ``host:port``.
        timeout: Time limit for an answer in s; None: no limit.
        introduction: The service's description of itself.
    """

    _server: ClassVar[str] = "service"
    _advice: ClassVar[str] = "Set a longer timeout if its steps take that long."

    def __init__(
        self,
        address: tuple[str, int],
        role: int,
        *,
        token: str | None = None,
        token_file: str | None = None,
        timeout: float | None = 60.0,
        connect_timeout: float = 10.0,
        max_answer: int = MAX_ANSWER,
        transport: Transport = SOCKETS,
    ) -> None:
        """Connect; retry while nothing listens.

        Args:
            address: Host and port.
            role: `ACT` or `OBSERVE`.
            token: See `TokenOptions`, also for the options below.
            token_file: File with the token.
            timeout: Time limit for an answer in s; None: no limit.
            connect_timeout: Time in s to keep trying to connect.
            max_answer: Size of the longest accepted answer in bytes.
            transport: What connects, and the clock that the time limits follow.
        """
        super().__init__(address, transport)
        self.timeout = timeout
        found = find_token(token_file, token)
        if found is None:
            raise ConfigError(
                f"A client of {self.name} needs the service's token: set {TOKEN_VARIABLE}, or pass "
                "token_file=, the file that contains it, or token=."
            )
        try:
            self._reader = self._meet(address, found, role, connect_timeout)
        except PlainRefusedError:
            self._reader = self._meet(address, found, role, connect_timeout, encrypted=True)
        try:
            self._reader.limit = max_answer
            self._begin()
            self.introduction = self._receive_introduction(connect_timeout)
        except BaseException:
            self._socket.close()
            raise

    def _meet(
        self,
        address: tuple[str, int],
        token: str,
        role: int,
        patience: float,
        *,
        encrypted: bool = False,
    ) -> FrameReader:
        """Connect, and authenticate both sides with the token."""
        until = self._clock.monotonic() + patience
        unread = _BACKLOG if role == OBSERVE else None
        self._socket = self._reach(
            lambda left: self._transport.connect(address, left, unread=unread), patience
        )
        try:
            return self._authenticate(
                token, role, max(until - self._clock.monotonic(), 1.0), encrypted=encrypted
            )
        except BaseException:
            self._socket.close()
            raise

    def _authenticate(
        self, token: str, role: int, patience: float, *, encrypted: bool
    ) -> FrameReader:
        self._socket.settimeout(patience)
        try:
            self._socket = encrypt(self._socket, always=encrypted)
            return introduce(self._socket, token, role, self._clock)
        except PlainRefusedError:
            raise
        except SilentPeerError as error:
            raise RemoteTimeoutError(
                f"{self.name} did not answer within {patience:.3g} s. It may be stopped, or speak "
                "another protocol; set a longer connect_timeout if it is busy for that long."
            ) from error
        except UnansweredError as error:
            raise RemoteClosedError(
                f"{self.name} did not answer like a physx service: {error} It may have closed the "
                "connection because its token differs, because too many clients are connected, or "
                "because it speaks another protocol."
            ) from error
        except ConnectionRefusedByPeerError as error:
            raise RemoteError(
                f"{self.name} cannot be trusted: it does not know this client's token, or is not "
                "a service of this version of physx. Set the service's token: "
                f"{TOKEN_VARIABLE}, token_file= or token=. ({error})"
            ) from error

    def _receive_introduction(self, patience: float) -> dict[str, Any]:
        """Return the service's description of itself."""
        frame = self.receive(patience)
        try:
            told = self.decode(frame) if frame.kind in (Kind.SETUP, Kind.ERROR) else None
        except RemoteError:
            raise
        except PhysxError as error:
            raise RemoteError(f"{self.name} refused: {error}") from error
        if not isinstance(told, dict) or told.get("service") != SERVICE:
            raise RemoteError(
                f"{self.name} does not serve environments; it may be the server of a run, which is "
                "for physx client."
            )
        if told.get("version") != VERSION:
            raise RemoteError(
                f"The service at {self.name} speaks version {told.get('version')} of the protocol, "
                f"but this client speaks version {VERSION}. Install the same version of physx-core "
                "on both sides."
            )
        return told

    # ----------------------------------------------------------------------------------------

    @property
    def is_closed(self) -> bool:
        """Whether the connection is closed."""
        return bool(self._why_closed)

    def send(self, message: bytes) -> None:
        """Send a message."""
        self._send(message, self.timeout)

    def receive(self, patience: float | None = None) -> Frame:
        """Return the next message.

        Args:
            patience: Time to wait in s; None: as long as an answer may take.
        """
        limit = self.timeout if patience is None else patience
        frame = self.look(limit)
        if frame is None:
            raise self._late(limit)
        return frame

    def look(self, patience: float | None) -> Frame | None:
        """Return the next message; None if there is none in time.

        Args:
            patience: Time to wait in s; None: forever.
        """
        self._check_open()
        until, left = None, patience
        try:
            while True:
                if not self._reader.has_buffered and not self._wait(left):
                    return None
                frame = self._reader.read(self._socket)
                if frame is not None:
                    return frame
                if patience is not None:
                    until = self._clock.monotonic() + patience if until is None else until
                    left = until - self._clock.monotonic()
                    if left <= 0:
                        return None
        except (EOFError, OSError) as error:
            raise self._broken(error) from error
        except ConnectionRefusedByPeerError as error:
            self.close(str(error))
            raise RemoteProtocolError(f"{self.name}: {error}") from error
        except BaseException as error:
            self.close(f"{type(error).__name__} {error}".rstrip())
            raise

    def decode(self, frame: Frame) -> Any:
        """Return the value in a message."""
        try:
            if frame.kind not in (Kind.REFUSAL, Kind.ERROR):
                return decode(frame.payload)
            refusal = decode_error(frame.payload)
        except ConnectionRefusedByPeerError as error:
            self.close(str(error))
            raise RemoteProtocolError(f"{self.name}: {error}") from error
        raise refusal

    def protocol_error(self, what: str) -> RemoteProtocolError:
        """Close the connection; return the error for a service that sent something invalid."""
        self.close(f"it sent {what}")
        return RemoteProtocolError(f"{self.name} sent {what}. The connection is closed.")
