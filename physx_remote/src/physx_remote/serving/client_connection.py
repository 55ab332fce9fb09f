"""ClientConnection: base class of the clients' connections, independent of the protocol."""

from __future__ import annotations

import contextlib
import select
from collections.abc import Callable, Collection
from typing import Any, ClassVar

from physx_core.net import (
    SOCKETS,
    VANISHED,
    Link,
    Transport,
    is_loss,
    poll_peer,
    prepare_connection,
    retry,
)
from physx_remote.errors import RemoteClosedError, RemoteError, RemoteTimeoutError

_RETRY = 0.1


class ClientConnection:
    """A connection to a server, which cannot be reopened.

    Every wait is bounded by its time limit, and by about 15 s if the server's machine is lost.

    Attributes:
        name: The server as ``host:port``.
    """

    _server: ClassVar[str] = "server"
    """Name for the other side in messages."""
    _advice: ClassVar[str] = "It may be busy with another client, or waiting for one."
    """What to do if it does not answer in time, or a possible reason."""
    _socket: Link

    def __init__(self, address: tuple[str, int], transport: Transport = SOCKETS) -> None:
        """Store the address, and what connects to it."""
        self._transport, self._clock = transport, transport.clock
        self.name = "{}:{}".format(*address)
        self._why_closed = ""
        self._buffered: Collection[Any] = ()

    def _reach(self, connect: Callable[[float], Link], patience: float) -> Link:
        """Return a connected link; retry while nothing listens.

        Args:
            connect: Connects within a time in s.
            patience: Time in s to keep trying.
        """
        try:
            errors = ConnectionRefusedError, TimeoutError
            return retry(connect, patience, _RETRY, *errors, clock=self._clock)
        except (ConnectionRefusedError, TimeoutError) as error:
            raise RemoteTimeoutError(
                f"Nothing answered at {self.name} within {patience:g} s: {error}. Start the "
                f"{self._server} first, or set a longer connect_timeout."
            ) from error
        except OSError as error:
            raise RemoteError(f"{self.name} cannot be reached: {error}.") from error

    def _begin(self) -> None:
        """Prepare the connected link for `_send` and `_wait`."""
        prepare_connection(self._socket)
        self._socket.setblocking(False)
        self._buffered = getattr(self._socket, "buffered", ())  # see SecureSocket
        self._readable = self._transport.poll(self._socket)
        self._writable = self._transport.poll(self._socket, select.POLLOUT)

    def _send(self, message: bytes, patience: float | None) -> None:
        """Send a message.

        Args:
            message: The message.
            patience: Time in s that the server may take to read any of it; None: unlimited.
        """
        self._check_open()
        rest = memoryview(message)
        try:
            while True:
                with contextlib.suppress(BlockingIOError):
                    rest = rest[self._socket.send(rest) :]
                if not rest:
                    return
                if not poll_peer(self._writable, self._socket, patience, self._clock):
                    raise self._late(patience)
        except OSError as error:
            raise self._broken(error) from error

    def _wait(self, patience: float | None) -> bool:
        """Wait until there is something to read; return whether there is.

        Args:
            patience: Time to wait in s; None: forever.

        Raises:
            OSError: If the server's machine no longer answers.
        """
        return bool(self._buffered) or poll_peer(
            self._readable, self._socket, patience, self._clock
        )

    def _late(self, patience: float | None) -> RemoteTimeoutError:
        """Close the connection; return the error for an answer that did not arrive in time."""
        self.close(f"an answer took longer than {patience} s")
        return RemoteTimeoutError(
            f"{self.name} did not answer within {patience} s. The connection is closed. "
            f"{self._advice}"
        )

    def _broken(self, error: Exception) -> RemoteClosedError:
        """Close the connection; return the error for a connection that was lost or closed."""
        is_lost = is_loss(error.__cause__ or error)
        self.close(VANISHED if is_lost else str(error))
        if is_lost:
            return RemoteClosedError(f"The connection to {self.name} was lost: {VANISHED}.")
        return RemoteClosedError(f"{self.name} closed the connection: {error}.")

    def _check_open(self) -> None:
        """Check that the connection is not closed."""
        if self._why_closed:
            raise RemoteClosedError(f"The connection to {self.name} is closed: {self._why_closed}.")

    def close(self, why: str = "it was closed here") -> None:
        """Close the connection; calling it again does nothing.

        Args:
            why: Reason to state in errors of later calls.
        """
        self._why_closed = self._why_closed or why
        self._socket.close()
