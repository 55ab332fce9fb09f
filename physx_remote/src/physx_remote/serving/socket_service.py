"""SocketService: serves all its connections in one thread, one request at a time."""

from __future__ import annotations

import math
import selectors
import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

from physx_core.errors import PhysxError
from physx_core.net import (
    SOCKETS,
    VANISHED,
    Link,
    Listener,
    PendingConnections,
    Reader,
    Transport,
    is_loopback,
    is_loss,
)
from physx_remote.errors import RemoteClosedError, RemoteError
from physx_remote.serving.client_log import ClientLog
from physx_remote.serving.connection import SPIN_LIMIT, RequestConnection
from physx_remote.serving.framing import PrefixReader
from physx_remote.serving.service import LOG, Service

_READ = selectors.EVENT_READ
_SLICE = 0.02
_MIN_PENDING = 32

Work = Iterator[float]
"""A request in progress: yields the time in s until it resumes."""


class SocketService(Service):
    """A service whose clients connect to a socket, or that is connected to a peer's socket.

    `handle` is called with one message at a time, from any connection. While the work that it
    returns is in progress, no other message is handled, but connections are accepted, read and
    closed, and timers run. A client that sends faster than it is served, or does not read its
    answers, has to wait. A connection is pending at first, and a client after `welcome`.

    Attributes:
        connections: All open connections.
        log: Log of the clients' actions.
    """

    encrypts: ClassVar[bool] = False
    """Whether the protocol encrypts what leaves this machine, and authenticates."""

    def __init__(self, *, max_clients: int = 256, transport: Transport = SOCKETS) -> None:
        """Start without connections.

        Args:
            max_clients: Maximum number of clients; further ones are turned away. In addition, as
                many pending connections are kept, but at least 32; if another arrives, one of them
                is closed.
            transport: What connects the clients, and the clock that the service follows.
        """
        self.address = ("", 0)
        self.connections: list[RequestConnection] = []
        self._max_clients = max_clients
        self._transport, self._clock = transport, transport.clock
        self.log = ClientLog(self.after)
        self._listener: Listener[RequestConnection]
        self._pending: PendingConnections[RequestConnection]
        self._ready: deque[RequestConnection] = deque()
        self._work: tuple[RequestConnection, Work] | None = None
        self._recent: RequestConnection | None = None
        self._resume_at = self._looked = 0.0
        self._lock = threading.RLock()
        self._is_open = self._is_polling = self._has_more = self._over = self._released = False

    # For a subclass to implement ---------------------------------------------------------------

    @abstractmethod
    def handle(self, connection: RequestConnection, body: Any) -> Work | None:
        """Handle one message; return the remaining work if it is not completed immediately."""

    def on_open(self, connection: RequestConnection) -> None:
        """Handle a new connection."""

    def on_first_message(self, connection: RequestConnection) -> None:
        """Handle the first complete message of a connection; by default it becomes a client."""
        self.welcome(connection)

    def on_fault(self, connection: RequestConnection, error: PhysxError) -> None:
        """Handle a protocol violation, or the loss of the client's machine.

        By default, the connection is dropped.
        """
        self.drop(connection, str(error))

    def on_close(self, connection: RequestConnection) -> None:
        """Handle the end of a connection; nothing can be sent on it."""

    def on_drain(self, connection: RequestConnection) -> None:
        """Handle that all delayed data have been sent."""

    def admits(self, connection: RequestConnection) -> bool:
        """Return whether a message of this connection may be handled now."""
        return True

    def new_reader(self) -> Reader:
        """Return the reader of a new connection."""
        return PrefixReader()

    def new_pending(self) -> PendingConnections[RequestConnection]:
        """Return what manages the connections that are not clients yet; called once."""
        return PendingConnections(self.max_pending, self.drop)

    @property
    def max_pending(self) -> int:
        """Maximum number of connections that are not clients yet."""
        return max(self._max_clients, _MIN_PENDING)

    @property
    def is_listening(self) -> bool:
        """Whether `listen` was called."""
        return self._is_open and self._listener.address[1] > 0

    # For a subclass to call ----------------------------------------------------------------------

    def listen(self, address: str, port: int) -> None:
        """Start accepting connections.

        Args:
            address: Address of this machine.
            port: Port; 0: any free one.

        Raises:
            RemoteError: If the address is not one of this machine, or the port is in use.
        """
        self._open()
        self._warn_of(address)
        try:
            self._listener.listen(address, port)
        except OSError as error:
            raise RemoteError(
                f"Cannot listen at {address} port {port}: {error}. Use an address of this machine, "
                "and a port that no other program uses; port 0 chooses a free one."
            ) from error
        self.address = self._listener.address

    def adopt(self, link: Link) -> RequestConnection:
        """Serve a link that is already connected."""
        self._open()
        host, port = link.getpeername()[:2]
        if not self.is_listening:
            self._warn_of(host)
        connection = RequestConnection(link, self.new_reader(), f"{host}:{port}", self._clock)
        self._pending.add(connection)
        self.connections.append(connection)
        self._listener.add(connection)
        self.on_open(connection)
        return connection

    def _warn_of(self, host: str) -> None:
        if not (self.encrypts or is_loopback(host)):
            LOG.warning(
                "%s is not a loopback address, and this protocol neither encrypts nor "
                "authenticates: anyone on the network path can read and modify the data, and "
                "anyone who can reach the port can drive the environment. Use a tunnel, or the "
                'protocol "physx".',
                host,
            )

    def welcome(self, connection: RequestConnection) -> None:
        """Count a connection as a client from now on.

        Raises:
            RemoteError: If there are too many clients.
        """
        self._pending.forget(connection)
        if len(self.connections) - len(self._pending) > self._max_clients:
            raise RemoteError(
                f"Too many clients are connected: max_clients is {self._max_clients}. Try again "
                "when one has left."
            )

    def send(self, connection: RequestConnection, *parts: bytes | memoryview) -> None:
        """Send parts as one piece; a broken connection is dropped without an error."""
        if connection.closed:
            return
        try:
            connection.write(*parts)
        except OSError as error:
            self.drop(connection, f"{error}")

    def drop(self, connection: RequestConnection, reason: str = "") -> None:
        """Close a connection; its request in progress is completed but not answered.

        Args:
            connection: The connection.
            reason: Reason to log; empty: nothing is logged.
        """
        if connection.closed:
            return
        if reason:
            self.log.warning(connection.name, "Connection to %s ended: %s", connection.name, reason)
        connection.close()
        self.connections.remove(connection)
        self._pending.forget(connection)
        if connection in self._ready:
            self._ready.remove(connection)
        self.on_close(connection)

    def after(self, seconds: float, action: Callable[[], None]) -> None:
        """Call a function once, `seconds` from now, between two messages."""
        self._open()
        self._listener.timers.add(seconds, action)

    # The loop -------------------------------------------------------------------------------

    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived; see `Service.poll`."""
        # Another thread may be in `close`: at least one of the two sees that the other is active.
        self._is_polling = True
        try:
            if not self._over:
                self._cycle(timeout)
        finally:
            self._is_polling = False
            if self._over:
                self._release()
        return not self._over

    def close(self) -> None:
        """Close all connections; may be called from any thread, and within a request."""
        self._over = True
        if not self._is_polling:
            self._release()
            return
        with self._lock:
            if self._is_open and not self._released:
                self._listener.wake()

    def _cycle(self, timeout: float | None) -> None:
        if not self._is_open:
            self._open()
        if not self._poll_last_client(timeout):
            self._run_once(timeout)
        is_due = self._listener.timers.next <= self._clock.monotonic()
        if self._work is not None or self._ready or is_due:
            self._turn()
        else:
            self._has_more = False

    def _poll_last_client(self, timeout: float | None) -> bool:
        """Handle the next message of a quick client that is alone, if it comes within a moment."""
        connection, self._recent = self._recent, None
        if connection is None or not connection.is_quick or connection.closed:
            return False
        if len(self.connections) > 1 or self._work is not None:
            return False
        wait = self._wait(timeout)
        if wait is not None and wait < SPIN_LIMIT:
            return False
        if self._clock.monotonic() - self._looked > _SLICE:
            return False
        try:
            # For such a short time, polling is faster than being woken by the system.
            if not self._transport.spin_until(connection.receive, SPIN_LIMIT):
                return False
        except OSError as error:
            self._on_io_error(connection, error)
            return True
        self._answer(connection)
        return True

    def _run_once(self, timeout: float | None) -> None:
        """Handle the events reported by the selector."""
        for connection, events in self._listener.select(self._wait(timeout)):
            self._serve(connection, events)
        self._looked = self._clock.monotonic()
        self._listener.accept()

    def _open(self) -> None:
        """Acquire the system resources of the loop."""
        with self._lock:
            if not (self._is_open or self._released):
                self._is_open = True
                self._listener = Listener(
                    self._meet, self._give_up, encrypts=self.encrypts, transport=self._transport
                )
                self._pending = self.new_pending()

    def _release(self) -> None:
        with self._lock:
            if self._released:
                return
            self._released = True
            if not self._is_open:
                return
            self._work = None
            for connection in [*self.connections]:
                self.drop(connection)
            self.log.summarize()
            self._listener.close()

    def _wait(self, timeout: float | None) -> float | None:
        """Return how long to wait for something to arrive."""
        if self._has_more:
            return 0.0
        moment = self._listener.timers.next
        if self._work is not None:
            moment = min(moment, self._resume_at)
        if moment == math.inf:
            return timeout
        wait = max(0.0, moment - self._clock.monotonic())
        return wait if timeout is None else min(wait, timeout)

    def _turn(self) -> None:
        """Run timers, and work until there is none left or others have waited long enough."""
        begin = self._clock.monotonic()
        self._listener.timers.call_due()
        self._has_more = True
        while not self._over:
            if self._work is not None:
                if self._resume_at > self._clock.monotonic():
                    self._has_more = False
                    return
                self._go_on()
            else:
                connection = self._next()
                if connection is None:
                    self._has_more = False
                    return
                self._begin(connection)
            if self._clock.monotonic() - begin > _SLICE:
                return

    def _next(self) -> RequestConnection | None:
        """Return the admitted connection whose message has waited longest."""
        for _ in range(len(self._ready)):
            connection = self._ready.popleft()
            if not connection.outgoing and self.admits(connection):
                return connection
            self._ready.append(connection)
        return None

    def _begin(self, connection: RequestConnection) -> None:
        body, connection.body = connection.body, None
        try:
            work = self.handle(connection, body)
        except BaseException as error:
            self._failed(connection, error)
            return
        if work is None:
            self._after(connection)
            return
        self._work = connection, work
        self._go_on()

    def _go_on(self) -> None:
        """Run the work in progress until it has to wait or is done."""
        if self._work is None:
            return
        connection, work = self._work
        try:
            self._resume_at = self._clock.monotonic() + next(work)
        except StopIteration:
            self._work = None
            self._after(connection)
        except BaseException as error:
            self._work = None
            self._failed(connection, error)

    def _failed(self, connection: RequestConnection, error: BaseException) -> None:
        """Drop the connection whose request could not be handled."""
        if not isinstance(error, Exception):
            self.drop(connection, "the service ends")
            raise error
        self.log.error(connection.name, "A request from %s failed", connection.name, cause=error)
        self.drop(connection, f"{type(error).__name__}: {error}")

    def _after(self, connection: RequestConnection) -> None:
        """Check for the next message of a connection, or for its end."""
        if connection.closed:
            return
        connection.touch()
        if connection.is_quiet and connection.events == _READ:
            self._recent = connection
            return
        try:
            if self._take_body(connection):
                self._ready.append(connection)
            elif connection.ended and not connection.outgoing:
                half = connection.reader.waiting
                self.drop(connection, f"in the middle of a message ({half} bytes)" if half else "")
                return
        except PhysxError as error:
            self.on_fault(connection, error)
            return
        connection.watch()

    def _serve(self, connection: RequestConnection, events: int) -> None:
        """Receive from a connection and send to it, as reported by the selector."""
        if connection.closed:
            return
        had_body = connection.body is not None
        try:
            if events & selectors.EVENT_WRITE:
                connection.flush()
                if not connection.outgoing:
                    self.on_drain(connection)
            if events & selectors.EVENT_READ:
                connection.receive()
        except OSError as error:
            self._on_io_error(connection, error)
            return
        if had_body and connection.ended and not self.admits(connection):
            self.drop(connection, "it left before its turn")
        elif had_body or (self._work is not None and self._work[0] is connection):
            connection.watch()
        elif self._ready or self._work is not None or self._over:
            self._after(connection)
        else:
            self._answer(connection)

    def _answer(self, connection: RequestConnection) -> None:
        """Handle the message that has just arrived, if no other is waiting."""
        try:
            if self._take_body(connection) and self.admits(connection) and not connection.outgoing:
                self._begin(connection)
                return
        except PhysxError as error:
            self.on_fault(connection, error)
            return
        self._after(connection)

    def _take_body(self, connection: RequestConnection) -> bool:
        """Put the next complete message into `body`; return whether there is one."""
        if not connection.next_body():
            return False
        if connection in self._pending:
            self.on_first_message(connection)
        return True

    def _meet(self, link: Link, name: str) -> None:
        self.adopt(link)

    def _on_io_error(self, connection: RequestConnection, error: OSError) -> None:
        if is_loss(error):
            self._give_up(connection)
        else:
            self.drop(connection, str(error))

    def _give_up(self, connection: RequestConnection) -> None:
        self.on_fault(connection, RemoteClosedError(VANISHED))
