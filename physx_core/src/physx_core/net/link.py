"""Link, Transport: what servers and clients exchange bytes through; tests simulate it."""

from __future__ import annotations

import select
import selectors
import socket
from collections.abc import Callable, Iterable
from typing import Any, Protocol, Self

from physx_core.clock import SYSTEM_CLOCK, Clock
from physx_core.net.spin_wait import spin_until

_BACKLOG = 128


class Link(Protocol):
    """One end of a connection: the part of `socket.socket` that physx uses.

    It is one on TCP or Unix sockets, a `SecureSocket`, or a simulated one, which has no descriptor.
    """

    def __enter__(self) -> Self:
        """Return the link."""

    def __exit__(self, *_: object) -> None:
        """Release the link."""

    @property
    def family(self) -> int:
        """Family of the addresses; only of Internet addresses may the peer be elsewhere."""

    def fileno(self) -> int:
        """Return the descriptor, -1 if there is none."""

    def getpeername(self) -> Any:
        """Return the peer's address."""

    def settimeout(self, seconds: float | None, /) -> None:
        """Set how long calls may block in s; None: forever."""

    def gettimeout(self) -> float | None:
        """Return how long calls may block in s; None: forever."""

    def setblocking(self, flag: bool, /) -> None:
        """Set whether calls may block at all."""

    def setsockopt(self, level: int, option: int, value: int, /) -> None:
        """Set an option."""

    def getsockopt(self, level: int, option: int, size: int, /) -> bytes:
        """Return an option."""

    def recv(self, size: int, /) -> bytes:
        """Receive at most `size` bytes; none at the end of the stream."""

    def recv_into(self, buffer: Any, /) -> int:
        """Receive into a buffer; return the number of bytes, 0 at the end of the stream."""

    def send(self, data: Any, /) -> int:
        """Send as much as is taken now; return the number of bytes."""

    def sendall(self, data: Any, /) -> None:
        """Send everything."""

    def sendmsg(self, parts: Iterable[Any], /) -> int:
        """Send parts as one piece, as much as is taken now; return the number of bytes."""

    def shutdown(self, how: int, /) -> None:
        """End one direction or both."""

    def close(self) -> None:
        """Release the link."""


class ListeningLink(Protocol):
    """What accepts connections: the part of `socket.socket` that physx uses."""

    def fileno(self) -> int:
        """Return the descriptor, -1 if there is none."""

    def getsockname(self) -> Any:
        """Return the own address."""

    def setblocking(self, flag: bool, /) -> None:
        """Set whether `accept` may block."""

    def accept(self) -> tuple[Any, Any]:
        """Return the link of the next connection, and the peer's address."""

    def close(self) -> None:
        """Stop listening."""


class Poll(Protocol):
    """Watches one link, as `select.poll` does."""

    def poll(self, milliseconds: float | None = None, /) -> list[Any]:
        """Wait for events; return what occurred."""


class Transport:
    """Sockets, and the clock by which those that use them wait; tests derive a simulated one.

    Attributes:
        clock: The clock.
        spin_until: See `spin_wait.spin_until`.
    """

    clock: Clock = SYSTEM_CLOCK
    spin_until: Callable[..., Any] = staticmethod(spin_until)

    def listen(self, address: str, port: int) -> ListeningLink:
        """Return what accepts connections to an address of this machine, port 0: any free one.

        Raises:
            OSError: If the address is not one of this machine, or the port is in use.
        """
        try:
            found = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)
            family, place = found[0][0], found[0][4]
            return socket.create_server(place, family=family, backlog=_BACKLOG)
        except (OverflowError, UnicodeError, TypeError) as error:
            raise OSError(str(error)) from error

    def connect(
        self, address: tuple[str, int], timeout: float, *, unread: int | None = None
    ) -> Link:
        """Connect to a host and port.

        Args:
            address: Host and port.
            timeout: How long an attempt may take, and each call on the link, in s.
            unread: How many received bytes the system keeps until they are read; None: it decides.

        Raises:
            OSError: If it cannot be reached.
        """
        error = OSError("the host has no address")
        for family, kind, proto, _, place in socket.getaddrinfo(*address, type=socket.SOCK_STREAM):
            connected = socket.socket(family, kind, proto)
            try:
                if unread is not None:  # it has no effect once it is connected
                    connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, unread)
                connected.settimeout(timeout)
                connected.connect(place)
                return connected
            except OSError as failed:
                connected.close()
                error = failed
        raise error

    def pair(self) -> tuple[Link, Link]:
        """Return the two ends of a connection within this process."""
        return socket.socketpair()

    def selector(self) -> selectors.BaseSelector:
        """Return a selector for links and listening links."""
        return selectors.DefaultSelector()

    def poll(self, link: Link, events: int = select.POLLIN) -> Poll:
        """Return what watches one link for events."""
        poll = select.poll()
        poll.register(link, events)
        return poll


SOCKETS = Transport()
"""The sockets of this machine."""
