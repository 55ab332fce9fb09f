"""Listener: accepts a server's connections and watches all of them with one selector."""

from __future__ import annotations

import contextlib
import logging
import selectors
import socket
from collections.abc import Callable
from typing import Any, Generic, TypeVar
from weakref import WeakSet

from physx_core.closeable import Closeable
from physx_core.net.addresses import is_loopback
from physx_core.net.connection import Connection
from physx_core.net.link import SOCKETS, Link, ListeningLink, Transport
from physx_core.net.liveness import CHECK_INTERVAL, has_vanished
from physx_core.net.timers import Timers
from physx_core.net.tls import Identity, SecureSocket

_ACCEPTED_AT_ONCE = 16
_PAUSE = 0.5
_LOG = logging.getLogger("physx")

AnyConnection = TypeVar("AnyConnection", bound=Connection)


class Listener(Closeable, Generic[AnyConnection]):
    """The links of one server: a listening one and any number of connected ones.

    Attributes:
        address: Host and port where it listens; an empty host: it does not listen.
        timers: Functions to be called later; the listener's owner calls those that are due.
    """

    def __init__(
        self,
        accepted: Callable[[Link, str], Any],
        vanished: Callable[[AnyConnection], Any],
        *,
        encrypts: bool = False,
        transport: Transport = SOCKETS,
    ) -> None:
        """Start without listening.

        Args:
            accepted: Called with each new connection and its peer as ``host:port``.
            vanished: Called with a connection if the peer's machine no longer answers.
            encrypts: Whether clients may encrypt; `accepted` then gets a `SecureSocket`.
            transport: What it listens on.
        """
        self.address = ("", 0)
        self.timers = Timers(transport.clock)
        self._transport = transport
        self._accepted, self._vanished = accepted, vanished
        self._connections: WeakSet[AnyConnection] = WeakSet()
        self._is_watching = self._has_guests = False
        self._identity = Identity() if encrypts else None
        self._buffered: set[SecureSocket] = set()
        self._link: ListeningLink | None = None
        self._selector = transport.selector()
        self._waker, self._wakes = transport.pair()
        for one in (self._waker, self._wakes):
            one.setblocking(False)
        self._selector.register(self._waker, selectors.EVENT_READ)

    @property
    def is_listening(self) -> bool:
        """Whether connections are accepted."""
        return self._link is not None

    def listen(self, address: str, port: int) -> None:
        """Start accepting connections.

        Args:
            address: Address of this machine.
            port: Port, 0 for any free one.

        Raises:
            OSError: If the address is not one of this machine, or the port is in use.
        """
        self._link = self._transport.listen(address, port)
        if self._identity is not None and not is_loopback(address):
            self._identity.prepare()
        self._link.setblocking(False)
        self.address = self._link.getsockname()[:2]
        self._selector.register(self._link, selectors.EVENT_READ)

    def add(self, connection: AnyConnection) -> None:
        """Watch a connection until it is closed."""
        connection.attach(self._selector)
        self._connections.add(connection)
        if not self._is_watching:
            self._is_watching = True
            self.timers.add(CHECK_INTERVAL, self._check_liveness)

    def select(self, timeout: float | None, spin: float = 0.0) -> list[tuple[AnyConnection, int]]:
        """Return the connections with pending events, and these events.

        Args:
            timeout: How long to wait for the first event, in s; None: forever.
            spin: How long to poll for it without sleeping before that, in s.
        """
        select = self._selector.select
        buffered = self._find_buffered() if self._buffered else {}
        if buffered:
            timeout, spin = 0.0, 0.0
        found = (spin and self._transport.spin_until(lambda: select(0), spin)) or select(timeout)
        ready = []
        for key, events in found:
            if key.data is not None:
                ready.append((key.data, events | buffered.pop(key.data, 0)))
            elif key.fileobj is self._waker:
                self._waker.recv(1024)
            else:
                self._has_guests = True
        ready += buffered.items()
        return ready

    def _find_buffered(self) -> dict[AnyConnection, int]:
        """Return connections that may have received data that the selector does not see."""
        watched = self._selector.get_map()
        keys = [watched[one] for one in self._buffered if one in watched]
        return {key.data: selectors.EVENT_READ for key in keys if key.events & selectors.EVENT_READ}

    def accept(self) -> bool:
        """Accept some of the connections that `select` found; return whether there were any.

        To be called after closed connections have made room. A flood of new connections must not
        keep the others waiting.
        """
        if not self._has_guests:
            return False
        self._has_guests = False
        for _ in range(_ACCEPTED_AT_ONCE):
            if self._link is None:
                break
            try:
                connected, place = self._link.accept()
            except BlockingIOError:
                break
            except ConnectionError:  # it was gone before it was accepted
                continue
            except OSError as error:  # the process has too many open files
                _LOG.warning("Connections cannot be accepted for now: %s", error)
                self._selector.unregister(self._link)
                self.timers.add(_PAUSE, self._accept_again)
                break
            if self._identity is not None and isinstance(connected, socket.socket):
                connected = SecureSocket.of_server(connected, self._identity, self._buffered)
            with contextlib.suppress(OSError):  # gone already
                self._accepted(connected, "{}:{}".format(*place[:2]))
        return True

    def wake(self) -> None:
        """End the current or next `select`; may be called from any thread."""
        with contextlib.suppress(BlockingIOError):
            self._wakes.send(b"x")

    def close(self) -> None:
        """Stop listening; the owner closes the connections."""
        if self._link is not None:
            self._link.close()
            self._link = None
        self._waker.close()
        self._wakes.close()
        self._selector.close()

    def _check_liveness(self) -> None:
        alive = [one for one in self._connections if not one.closed]
        for connection in alive:
            if has_vanished(connection.link):
                self._vanished(connection)
        self._is_watching = bool(alive)
        if self._is_watching:
            self.timers.add(CHECK_INTERVAL, self._check_liveness)

    def _accept_again(self) -> None:
        if self._link is not None:
            self._selector.register(self._link, selectors.EVENT_READ)
