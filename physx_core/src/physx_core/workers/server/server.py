"""Server: accepts clients that know the token and serves them in one thread."""

from __future__ import annotations

import logging
import selectors
from collections.abc import Callable, Collection, Iterable

from physx_core.components.services import Services
from physx_core.config import EnvironmentConfig
from physx_core.errors import (
    ConfigError,
    ConnectionRefusedByPeerError,
    SampleError,
)
from physx_core.net.addresses import format_address
from physx_core.net.frames import MAX_PAYLOAD, Frame, Kind, pack
from physx_core.net.link import Link, Transport
from physx_core.net.listener import Listener
from physx_core.net.liveness import is_loss
from physx_core.net.pending import Handshakes
from physx_core.net.remote_errors import decode_error, encode_error
from physx_core.net.spin_wait import has_core_for_each
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.server.episode_pool import EpisodePool
from physx_core.workers.server.peer import Peer
from physx_core.workers.server.service_requests import ServiceRequests
from physx_core.workers.server.stream_pool import StreamPool
from physx_core.workers.server.validation import (
    check_environment_fields,
    check_row_fields,
    parse_fields,
    parse_parameters,
)

_HANDSHAKE_TIME = 5.0
_SPIN_TIME = 5e-5  # for the next requests of clients that were just answered
_MAX_STRANGERS = 128
_TURNS = 64
_LONG = 1 << 16
_LOG = logging.getLogger("physx")
_REQUESTS = (Kind.PREDICT, Kind.SAVE, Kind.LOAD, Kind.SHOW, Kind.CHOOSE, Kind.TOUCH)


class Server:
    """Serves the clients' connections; all work is done in calls to `pump`.

    Attributes:
        peers: Instance number to the connection of its client.
        token: Secret of the run.
        pool: What clients do, and who takes the place of a lost one.
        dispatch: Handles the messages of clients, by their kind.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        services: Services,
        setup: Callable[[Peer], bytes],
        token: str,
        sets: ParameterSets,
        pool: StreamPool | EpisodePool,
        reserved: Callable[[], Collection[int]],
        transport: Transport,
    ) -> None:
        """Store the arguments; `open` starts listening.

        Args:
            config: Where to listen, and how many clients there may be.
            services: The services of the run, for the environments.
            setup: Returns the payload that tells a client what to run.
            token: Secret of the run.
            sets: Chooses the instances' parameters.
            pool: What clients do, and who takes the place of a lost one.
            reserved: Returns the places that only clients that ask for them may take.
            transport: What connects the clients, and the clock that the server follows.
        """
        self.peers: dict[int, Peer] = {}
        self.token = token
        self._clock = transport.clock
        self._ip_address, self._port = config.ip_address, config.port
        self._instance_nb = instance_nb = config.places
        self._spin_time = _SPIN_TIME if has_core_for_each(instance_nb) else 0.0
        self._requests = ServiceRequests(services, sets)
        self.pool, self._setup, self._reserved = pool, setup, reserved
        self._ending = self._has_news = False
        self._listener = Listener[Peer](
            self._meet, self._give_up, encrypts=True, transport=transport
        )
        self._strangers = Handshakes[Peer](
            token, _HANDSHAKE_TIME, _MAX_STRANGERS, self._drop, self._listener.timers
        )
        self.dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            Kind.PARAMETERS: _take_parameters,
            Kind.READY: self._take_ready,
            Kind.FIELDS: _take_fields,
            Kind.ERROR: _take_error,
            Kind.BYE: self._take_bye,
            Kind.PING: _take_sign_of_life,
            **dict.fromkeys(_REQUESTS, self._requests.take),
        }

    def open(self, host: str | None = None) -> None:
        """Start listening, at `host` if given, else at the constructor's address."""
        host = host or self._ip_address
        try:
            self._listener.listen(host, self._port)
        except OSError as error:
            raise ConfigError(
                f"The server cannot listen on {host} port {self._port}: {error}. "
                "Choose EnvironmentConfig.port=0 for any free port, or an ip_address of this "
                "machine; ports below 1024 need privileges, and another run may use this one."
            ) from error

    @property
    def address(self) -> str:
        """``HOST:PORT`` at which clients on this machine reach the server."""
        if not self._listener.is_listening:
            raise ConfigError("The server is not open.")
        host, port = self._listener.address
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        return format_address(host, port)

    def pump(self, timeout: float) -> None:
        """Handle what has arrived; wait up to `timeout` s for the first message.

        Continues as long as predictions are requested and answered and nothing else happens, but
        no longer than `timeout`.
        """
        until = self._clock.monotonic() + timeout
        spin = 0.0
        while self._answer_at_once(timeout, spin) and self._clock.monotonic() < until:
            spin = self._spin_time
        self._listener.timers.call_due()

    def _answer_at_once(self, timeout: float, spin: float) -> bool:
        """Handle what has arrived; return whether it was only requests, all answered.

        Args:
            timeout: How long to wait for the first message, in s.
            spin: How long to spin-wait for it before that, in s.
        """
        self._has_news = False
        if self._can_predict():  # held requests that are due now
            timeout = 0.0
        for peer, events in self._listener.select(timeout, spin):
            if events & selectors.EVENT_WRITE:
                peer.flush()
                self._has_news = True
            if events & selectors.EVENT_READ:
                self._read(peer)
        if self._listener.accept():
            self._has_news = True
        if not self._can_predict():
            return False
        return self._requests.predict() and not self._has_news

    @property
    def asking(self) -> set[int]:
        """The instances that wait for a prediction, due or held."""
        return self._requests.asking

    def end(self) -> None:
        """Tell all clients to close their environments."""
        self._ending = True
        for peer in self.peers.values():
            peer.wanted = peer.granted  # nothing is held any longer
            peer.send(pack(Kind.CLOSE))

    def vacate(self, number: int) -> None:
        """Free an instance for its next client, which continues where this one failed or left."""
        peer = self.peers.get(number)
        if peer is not None:
            self._drop(peer)
            self._requests.forget(peer)
            peer.vacant, peer.failure, peer.heard = True, None, self._clock.monotonic()

    def close(self) -> None:
        """Close all connections; calling it again does nothing."""
        for peer in self.peers.values():
            self._drop(peer)
        self.pool.close()
        self._strangers.drop_all()
        self._listener.close()

    def holding_up(self, waited: Iterable[int]) -> set[int]:
        """Return the instances that hold up the server while it waits for some instances.

        Those that wait for a prediction are held up by the other awaited instances.
        """
        waited = set(waited)
        others = self._awaited() if waited & self.asking else set()
        return (waited | others) - self.asking

    def _can_predict(self) -> bool:
        """Return whether there are requests for predictions to answer."""
        due = self._requests.count
        return bool(due) and not (due < self._instance_nb and self._expects_more_requests())

    def _expects_more_requests(self) -> bool:
        """Return whether a client is generating an awaited row and may yet ask for a prediction.

        A batch is predicted once every client has asked or owes no row. So the requests in a
        batch depend on the environments, not on their speed: the rounding of a network's output
        may depend on the batch size.
        """
        if self._ending or not self._requests.batches:
            return False
        numbers, asking = range(1, self._instance_nb + 1), self._requests.asking
        return any(n not in asking and self._is_awaited(n) for n in numbers)

    def _awaited(self) -> set[int]:
        return {n for n in range(1, self._instance_nb + 1) if self._is_awaited(n)}

    def _is_awaited(self, number: int) -> bool:
        peer = self.peers.get(number)
        if peer is None or not peer.is_awaited:
            return peer is None
        return peer.vacant or not peer.is_lost or self.pool.replaces(number, peer.failure)

    def _meet(self, link: Link, name: str) -> None:
        peer = Peer(link, name, self._clock)
        self._strangers.add(peer)
        self._listener.add(peer)

    def _read(self, peer: Peer) -> None:
        turns = 0
        try:
            while not peer.closed:
                turns += 1
                frame = peer.reader.read(peer.link)
                if peer.instance_id:
                    peer.hear(whole=frame is not None)
                if frame is not None:
                    self._take(peer, frame)
                if frame is None or not peer.reader.may_have_more:
                    return
                enough = turns >= _TURNS or len(frame.payload) > _LONG
                if enough and not peer.reader.has_buffered:
                    # Give the others a turn; the selector finds the rest. Also, rows are moved to
                    # their places while they are in the processor's cache.
                    return
        except EOFError as error:
            peer.has_vanished = is_loss(error.__cause__)
            self._drop(peer)
        except ConnectionRefusedByPeerError as error:
            peer.violation = str(error)
            self._drop(peer)
        except SampleError as error:
            peer.failure, peer.failed_row = peer.failure or error, peer.received
            self._drop(peer)

    def _take(self, peer: Peer, frame: Frame) -> None:
        if not peer.instance_id:
            self._greet(peer, frame)
        elif frame.kind in self.dispatch:
            self._has_news |= frame.kind is not Kind.PREDICT
            self.dispatch[frame.kind](peer, frame)
        else:
            raise ConnectionRefusedByPeerError(
                f"It sent {frame.kind.name}, which a client may not send now."
            )

    def _greet(self, peer: Peer, frame: Frame) -> None:
        answer, wanted = self._strangers.greet(peer, frame)
        peer.send(answer)
        if wanted is None:
            return
        numbers = range(1, self._instance_nb + 1)
        free = [n for n in numbers if n not in self.peers or self.peers[n].vacant]
        if not wanted:
            free = [number for number in free if number not in self._reserved()]
        if not free or (wanted and wanted not in free):
            name = f"instance {wanted}" if wanted else "another client"
            refusal = ConnectionRefusedByPeerError(
                f"The server has no place for {name}: of its "
                f"{self._instance_nb} instances {free or 'none'} are free."
            )
            peer.send(pack(Kind.ERROR, encode_error(refusal)))
            raise refusal
        peer.instance_id = wanted or free[0]
        peer.reader.limit = MAX_PAYLOAD
        self.peers[peer.instance_id] = peer
        self.pool.adopt(peer)
        peer.send(pack(Kind.SETUP, self._setup(peer)))

    def _give_up(self, peer: Peer) -> None:
        """Drop a client whose machine no longer answers."""
        peer.has_vanished = True
        self._drop(peer)

    def _drop(self, peer: Peer, reason: str = "") -> None:
        if peer.closed:
            return
        self._has_news = True
        peer.close()
        self._strangers.forget(peer)

    # Messages of clients -----------------------------------------------------------------------

    def _take_bye(self, peer: Peer, frame: Frame) -> None:
        peer.has_left = not (self._ending or peer.failure)
        peer.finished = self._ending and peer.failure is None
        self._drop(peer)  # it waits for this

    def _take_ready(self, peer: Peer, frame: Frame) -> None:
        _take_ready(peer, frame)
        if peer.journal is not None:
            peer.journal.end_creation()


def _take_parameters(peer: Peer, frame: Frame) -> None:
    if peer.fields or peer.parameters:
        raise ConnectionRefusedByPeerError("It defined its parameters twice, or too late.")
    peer.parameters = parse_parameters(frame.payload)


def _take_ready(peer: Peer, frame: Frame) -> None:
    fields = parse_fields(frame.payload)
    if peer.fields:
        raise ConnectionRefusedByPeerError("It defined its fields twice.")
    check_environment_fields(fields)
    peer.episode_fields = [field for field in fields if field.role == "episode"]
    peer.fields = [field for field in fields if field.role != "episode"]
    peer.is_independent = bool(frame.number)
    if peer.resumed_requests is not None:
        peer.requests = peer.resumed_requests


def _take_fields(peer: Peer, frame: Frame) -> None:
    fields = parse_fields(frame.payload)
    if peer.has_told_fields:
        raise ConnectionRefusedByPeerError("It sent the fields of its rows twice.")
    check_row_fields(fields, peer.fields)
    if peer.row_fields and fields != peer.row_fields:
        raise ConnectionRefusedByPeerError(
            "The fields of its rows differ from those of its predecessor."
        )
    peer.row_fields, peer.has_told_fields = fields, True


def _take_sign_of_life(peer: Peer, frame: Frame) -> None:
    """Do nothing: the client is alive, but has no rows to send."""


def _take_error(peer: Peer, frame: Frame) -> None:
    peer.failure, peer.failed_row = decode_error(frame.payload), frame.number
