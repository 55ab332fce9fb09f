"""ClientConnection: base of the clients' connections, whatever they send."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import ClassVar

from physx_core.errors import RemoteClosedError, RemoteError, RemoteTimeoutError
from physx_core.net import retry

_RETRY = 0.1


class ClientConnection:
    """A connection to a server, which cannot be opened again.

    Attributes:
        name: The server as ``host:port``.
    """

    _server: ClassVar[str] = "server"
    """What the other side is called in messages."""
    _socket: socket.socket

    def __init__(self, address: tuple[str, int]) -> None:
        """Keep the address."""
        self.name = "{}:{}".format(*address)
        self._why_closed = ""

    def _reach(self, connect: Callable[[float], socket.socket], patience: float) -> socket.socket:
        """Return a connected socket; try again as long as nothing listens.

        Args:
            connect: Connects within a time in s.
            patience: How long to try, in s.
        """
        try:
            return retry(connect, patience, _RETRY, ConnectionRefusedError, TimeoutError)
        except (ConnectionRefusedError, TimeoutError) as error:
            raise RemoteTimeoutError(
                f"Nothing answers at {self.name} within {patience:g} s: {error}. Start the "
                f"{self._server} first, or give a longer connect_timeout."
            ) from error
        except OSError as error:
            raise RemoteError(f"{self.name} cannot be reached: {error}.") from error

    def _check_open(self) -> None:
        """Check that the connection is not closed."""
        if self._why_closed:
            raise RemoteClosedError(f"The connection to {self.name} is closed: {self._why_closed}.")

    def close(self, why: str = "it was closed here") -> None:
        """End the connection; calling it again does nothing.

        Args:
            why: The reason that later calls name.
        """
        self._why_closed = self._why_closed or why
        self._socket.close()
