"""PendingConnections: those that have not yet proved that they belong to a server."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Generic

from physx_core.net.frames import Frame
from physx_core.net.handshake import ServerHandshake
from physx_core.net.listener import AnyConnection
from physx_core.net.timers import Timers
from physx_core.net.tls import SecureSocket


class PendingConnections(Generic[AnyConnection]):
    """A limited number of connections that have not yet proved that they belong to a server.

    Connections that have proved it do not count, so pending ones cannot keep them out.
    """

    def __init__(self, most: int, drop: Callable[[AnyConnection, str], None]) -> None:
        """Start without any.

        Args:
            most: Maximum number of pending connections.
            drop: Closes a connection for a given reason and calls `forget`.
        """
        self._max_count, self._drop = most, drop
        self._waiting: dict[AnyConnection, None] = {}

    def __contains__(self, connection: AnyConnection) -> bool:
        """Return whether a connection is still pending."""
        return connection in self._waiting

    def __len__(self) -> int:
        """Return the number of pending connections."""
        return len(self._waiting)

    def add(self, connection: AnyConnection) -> None:
        """Count a new connection as pending.

        If there are too many, one of them is dropped at random, so that an attacker who occupies
        all places cannot keep out a client that retries.
        """
        if len(self._waiting) >= self._max_count:
            self._drop(secrets.choice([*self._waiting]), "too many connections are pending")
        self._waiting[connection] = None

    def forget(self, connection: AnyConnection) -> None:
        """Forget a connection; nothing happens if it is not pending."""
        self._waiting.pop(connection, None)

    def drop_all(self) -> None:
        """Drop all pending connections because the server is shutting down."""
        for connection in [*self._waiting]:
            self._drop(connection, "")


class Handshakes(PendingConnections[AnyConnection]):
    """Pending connections that must prove within a time limit that they know a token.

    Attributes:
        patience: Time that each may take for the next part of its handshake, in s.
    """

    def __init__(
        self,
        token: str,
        patience: float,
        most: int,
        drop: Callable[[AnyConnection, str], None],
        timers: Timers,
    ) -> None:
        """Start without any.

        Args:
            token: The token that they must know.
            patience: Time that each may take for the next part of its handshake, in s.
            most: Maximum number of pending connections.
            drop: Closes a connection for a given reason and calls `forget`.
            timers: Timers of the server.
        """
        super().__init__(most, drop)
        self.patience = patience
        self._token, self._timers = token, timers
        self._handshakes: dict[AnyConnection, ServerHandshake] = {}
        self._is_watching = False

    def add(self, connection: AnyConnection) -> None:
        """Start the handshake with a new connection; see `PendingConnections.add`."""
        super().add(connection)
        self._handshakes[connection] = ServerHandshake(self._token, self._timers.clock)
        if not self._is_watching:
            self._is_watching = True
            self._timers.add(self.patience, self._drop_silent)

    def greet(self, connection: AnyConnection, frame: Frame) -> tuple[bytes, int | None]:
        """Continue the handshake of a connection, which is removed once it is trusted.

        Returns:
            The bytes to send back, and the number that the client requests, None until trusted.

        Raises:
            ConnectionRefusedByPeerError: If the client violated the protocol, or does not know the
                token.
        """
        handshake = self._handshakes[connection]
        secure = connection.link if isinstance(connection.link, SecureSocket) else None
        answer = handshake.answer(frame, b"" if secure is None else secure.channel)
        if handshake.instance_id is not None:
            self.forget(connection)
            if secure is not None:
                connection.link = secure.unwrap_if_plain()
        return answer, handshake.instance_id

    def forget(self, connection: AnyConnection) -> None:
        """Forget a connection; nothing happens if it is not pending."""
        super().forget(connection)
        self._handshakes.pop(connection, None)

    def _drop_silent(self) -> None:
        limit = self._timers.clock.monotonic() - self.patience
        for connection, handshake in [*self._handshakes.items()]:
            if handshake.since < limit:
                self._drop(connection, f"no handshake within {self.patience:g} s")
        self._is_watching = bool(self._handshakes)
        if self._is_watching:
            self._timers.add(self.patience / 4, self._drop_silent)
