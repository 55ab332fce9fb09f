"""Communication: the server of an `RLEnvironment`."""

from __future__ import annotations

from typing import Any, Literal, get_args

from physx_core.errors import ConfigError, UsageError
from physx_core.net import SOCKETS, Reader, Transport, check_address
from physx_remote.errors import RequestError
from physx_remote.godot_gym.frames_timer import Signal
from physx_remote.godot_gym.messages import ERROR, encode_extension
from physx_remote.godot_gym.requests import JsonReader, parse_request
from physx_remote.serving.connection import RequestConnection
from physx_remote.serving.framing import MAX_REQUEST, PrefixReader, add_prefix
from physx_remote.serving.service import LOG
from physx_remote.serving.socket_service import SocketService, Work

Clients = Literal["queue", "refuse", "serve"]
Reply = Literal["always", "observation-only"]
RequestFraming = Literal["framed", "bare-json"]
Errors = Literal["tell", "close"]


class Communication(SocketService):
    """Serves JSON requests of clients, one at a time.

    Each request is answered exactly once: with the message passed to `put_message`, or with an
    empty one. A request that cannot be carried out is logged, and answered with the part ``error``
    of `physx_remote.godot_gym.messages`; the environment keeps running.

    Attributes:
        got_connection: Signal with a request, a dictionary. A connected function may return a
            generator that yields the time in s until it resumes.
    """

    def __init__(
        self,
        *,
        clients: Clients = "queue",
        reply: Reply = "always",
        request_framing: RequestFraming = "framed",
        errors: Errors = "tell",
        max_request: int = MAX_REQUEST,
        patience: float | None = None,
        max_clients: int = 256,
        transport: Transport = SOCKETS,
    ) -> None:
        """Store the options.

        Args:
            clients: What happens to a second client while one is being served (from its first
                request until it leaves). ``"queue"``: it waits; ``"refuse"``: it is disconnected;
                ``"serve"``: the requests of all clients are answered in turn.
            reply: ``"always"``, or ``"observation-only"``: answer only requests with an
                observation, as in the first version of the protocol.
            request_framing: ``"framed"``, or ``"bare-json"``: requests have no length prefix, as in
                the first version.
            errors: ``"tell"``, or ``"close"``: a request that cannot be carried out closes the
                connection.
            max_request: Longest request in bytes; clients that send longer ones are disconnected.
            patience: Time in s that a client may be silent while another waits; None: forever.
            max_clients: Maximum number of clients; further ones are disconnected at their first
                request. In addition, as many connections that have not sent a whole request are
                kept, but at least 32; if another arrives, one of them is closed.
            transport: What connects the clients, and the clock that `patience` follows.

        Raises:
            ConfigError: If a value is out of range.
        """
        super().__init__(max_clients=max_clients, transport=transport)
        choices = (
            ("clients", clients, Clients),
            ("reply", reply, Reply),
            ("errors", errors, Errors),
            ("request_framing", request_framing, RequestFraming),
        )
        for name, value, kinds in choices:
            if value not in get_args(kinds):
                known = ", ".join(f'"{kind}"' for kind in get_args(kinds))
                raise ConfigError(f"{name} is {value!r} but must be one of {known}.")
        for name, number in (("max_request", max_request), ("max_clients", max_clients)):
            if type(number) is not int or number < 1:
                raise ConfigError(f"{name} is {number!r} but must be an integer of at least 1.")
        if patience is not None and (type(patience) not in (int, float) or not patience > 0):
            raise ConfigError(f"patience is {patience!r} but must be a positive number of seconds.")
        self.got_connection = Signal()
        self._clients, self._reply, self._errors = clients, reply, errors
        self._framing, self._max_request, self._patience = request_framing, max_request, patience
        self._served: RequestConnection | None = None
        self._asking: RequestConnection | None = None
        self._answered = False

    @property
    def message_processing(self) -> bool:
        """Whether a request is being carried out."""
        return self._asking is not None

    @property
    def is_abandoned(self) -> bool:
        """Whether the client whose request is being carried out has left.

        A client that has shut down sending may still read; it counts as gone once another waits.
        """
        asking = self._asking
        if asking is None or not asking.ended:
            return asking is not None and asking.closed
        return any(other.body is not None for other in self.connections if other is not asking)

    def start_server(self, port: int, address: str = "127.0.0.1") -> None:
        """Start listening.

        Args:
            port: Port; 0: any free one.
            address: Address of this machine. There is no authentication: anyone who can reach it
                can drive the environment.

        Raises:
            UsageError: If it is already listening, or was closed.
            ConfigError: If the port or address is invalid.
            RemoteError: If it cannot listen there.
        """
        check_address(address, port)
        if self.is_listening:
            raise UsageError(f"The server is already listening at {self.address}.")
        if self._over:
            raise UsageError(
                "A closed environment cannot be served again: create another environment."
            )
        self.listen(address, port)
        LOG.info("Listening at %s:%s", *self.address)
        if self._patience is not None:
            self.after(self._patience / 4, self._drop_silent)

    def server_poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived; see `Service.poll`."""
        return self.poll(timeout)

    def put_message(self, message: Any = None) -> None:
        """Answer the current request.

        Args:
            message: A protobuf message, or its bytes; None: no data were requested.

        Raises:
            UsageError: If there is no current request, or it was already answered.
        """
        if self._asking is None:
            raise UsageError("put_message() answers the current request, but there is none.")
        if self._answered:
            raise UsageError("This request was already answered.")
        self._answered = True
        if message is None:
            if self._reply == "observation-only":
                return
            message = b""
        body = message if isinstance(message, bytes) else message.SerializeToString()
        self.send(self._asking, add_prefix(body))

    # Events of the loop -----------------------------------------------------------------------

    def new_reader(self) -> Reader:
        """Return a reader of requests."""
        kind = JsonReader if self._framing == "bare-json" else PrefixReader
        return kind(self._max_request)

    def on_open(self, connection: RequestConnection) -> None:
        """Close another client's connection, or log that the client waits."""
        if self._served is None or self._clients == "serve":
            self.log.info(connection.name, "%s connected", connection.name)
        elif self._clients == "refuse" and not self._served.ended:
            self.drop(connection, f"turned away while {self._served.name} is served")
        else:
            name, served = connection.name, self._served.name
            self.log.info(name, "%s waits until %s leaves", name, served)

    def on_close(self, connection: RequestConnection) -> None:
        """Free the place for the next client."""
        if connection is self._served:
            self.log.info(connection.name, "%s left", connection.name)
            self._served = None

    def admits(self, connection: RequestConnection) -> bool:
        """Return whether it is this client's turn."""
        return self._clients == "serve" or self._served in (None, connection)

    def handle(self, connection: RequestConnection, body: bytes) -> Work:
        """Carry out one request."""
        if self._served is None:
            self._serve_only(connection)
        self._asking, self._answered = connection, False
        try:
            request = parse_request(body)
            for work in self.got_connection.emit(request):
                if work is not None:
                    yield from work
            if not self._answered:
                self.put_message()
        except Exception as error:
            self._report(connection, error)
        finally:
            self._asking = None

    def _serve_only(self, connection: RequestConnection) -> None:
        if self._clients == "serve":
            return
        self._served = connection
        if self._clients == "refuse":
            for other in [*self.connections]:
                if other is not connection:
                    self.drop(other, f"turned away while {connection.name} is served")

    def _report(self, connection: RequestConnection, error: Exception) -> None:
        """Report an error in the log and to the client."""
        expected = isinstance(error, RequestError)
        text = str(error) if expected else f"{type(error).__name__}: {error}"
        cause = None if expected else error
        name = connection.name
        self.log.error(name, "A request from %s failed: %s", name, text, cause=cause)
        if self._answered:
            return
        if self._errors == "close":
            self.drop(connection, "its request failed")
        elif self._reply == "always":
            self.put_message(encode_extension(ERROR, text))

    def _drop_silent(self) -> None:
        """Disconnect a silent client that keeps others waiting."""
        patience, served = self._patience or 0.0, self._served
        self.after(patience / 4, self._drop_silent)
        others = any(c is not served for c in self.connections)
        idle = served is not None and self._asking is None and served.body is None
        if served is not None and idle and others and served.silence > patience:
            self.drop(served, f"silent for {patience:g} s while another waits")
