"""Server: listens, lets in who knows the token, and serves the clients in one thread."""

from __future__ import annotations

import secrets
import selectors
import socket
import time
from collections.abc import Callable, Iterable
from typing import Any

from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.fields import Field
from physx_core.interfaces.environment import Services
from physx_core.transport.answers import Answers
from physx_core.transport.failures import decode_error, encode_error
from physx_core.transport.frames import MAX_PAYLOAD, Frame, Kind, pack
from physx_core.transport.peer import Peer
from physx_core.transport.rows import unpack_rows
from physx_core.transport.values import decode

_HANDSHAKE_TIME = 5.0
_MAX_STRANGERS = 32


class Server:
    """Connections of the clients; nothing happens but in calls of `pump`.

    Attributes:
        peers: Instance number to the connection of its client.
        token: Random secret of the run.
    """

    def __init__(
        self,
        ip_address: str,
        port: int,
        instance_nb: int,
        services: Services,
        setup: Callable[[int], bytes],
        token: str | None = None,
    ) -> None:
        """Keep where to listen and what to tell clients.

        Args:
            ip_address: Address to listen at.
            port: Port to listen at, 0 for any free one.
            instance_nb: How many instances run.
            services: What the environments may ask of the run.
            setup: Makes the payload that tells an instance's client what to run.
            token: Secret of the run; None: a random one.
        """
        self.peers: dict[int, Peer] = {}
        self.token = secrets.token_hex(32) if token is None else token
        self._ip_address, self._port, self._instance_nb = ip_address, port, instance_nb
        self._answers = Answers(services)
        self._setup = setup
        self._ending = False
        self._strangers: list[Peer] = []
        self._selector = selectors.DefaultSelector()
        self._listener: socket.socket | None = None
        self._dispatch: dict[Kind, Callable[[Peer, Frame], None]] = {
            Kind.READY: self._ready,
            Kind.FIELDS: self._fields,
            Kind.ROWS: self._rows,
            Kind.ERROR: self._error,
            Kind.BYE: self._bye,
            **dict.fromkeys((Kind.PREDICT, Kind.SAVE, Kind.LOAD, Kind.SHOW), self._answers.take),
        }

    def open(self) -> None:
        """Begin to listen.

        Raises:
            ConfigError: The address is not one of this machine, or the port is in use.
        """
        where = f"{self._ip_address} port {self._port}"
        try:
            found = socket.getaddrinfo(self._ip_address, self._port, type=socket.SOCK_STREAM)
            family, address = found[0][0], found[0][4]
            self._listener = socket.create_server(address, family=family, backlog=128)
        except (OSError, OverflowError) as error:
            raise ConfigError(
                f"The server cannot listen at {where}: {error}. Choose EnvironmentConfig.port=0 "
                "for any free port, or an ip_address of this machine; a port below 1024 needs "
                "rights, and one that another run uses is taken."
            ) from error
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)

    @property
    def address(self) -> str:
        """``HOST:PORT`` at which clients on this machine reach the server."""
        if self._listener is None:
            raise ConfigError("The server is not open.")
        host, port = self._listener.getsockname()[:2]
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def pump(self, timeout: float) -> None:
        """Do what there is to do; wait up to `timeout` s for the first of it."""
        for key, events in self._selector.select(timeout):
            if key.data is None:
                self._accept()
                continue
            if events & selectors.EVENT_WRITE:
                key.data.flush()
            if events & selectors.EVENT_READ:
                self._read(key.data)
        if self._answers.asking and not self._expects_more_requests():
            self._answers.predict()
        self._watch()

    @property
    def asking(self) -> set[int]:
        """The instances that wait for a prediction."""
        return self._answers.asking

    def end(self) -> None:
        """Tell all clients to close their environments."""
        self._ending = True
        for peer in self.peers.values():
            peer.send(pack(Kind.CLOSE))

    def close(self) -> None:
        """Close all connections; calling it again does nothing."""
        for peer in [*self._strangers, *self.peers.values()]:
            self._drop(peer)
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._selector.close()

    def holding_up(self, waited: Iterable[int]) -> set[int]:
        """Return those that the server waits for in the end, where it waits for some instances.

        Those of them that wait for a prediction wait for the others that are at work.
        """
        waited = set(waited)
        others = self._at_work() if waited & self.asking else set()
        return (waited | others) - self.asking

    def _expects_more_requests(self) -> bool:
        """Return whether a client is at work that may yet ask for a prediction.

        A batch is predicted once every client asks or has nothing to do. So which requests are in
        a batch depends on the environments, and not on how fast each of them happens to be: the
        rounding of a network's result may depend on the size of the batch.
        """
        batches = self._answers.batches and not self._ending
        return batches and bool(self._at_work() - self.asking)

    def _at_work(self) -> set[int]:
        numbers = range(1, self._instance_nb + 1)
        return {n for n in numbers if n not in self.peers or self.peers[n].is_at_work}

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            connection, _ = self._listener.accept()
            peer = Peer(connection, self.token)
        except OSError:  # it was gone before it was accepted
            return
        if len(self._strangers) >= _MAX_STRANGERS:
            self._drop(self._strangers[0])
        self._strangers.append(peer)
        self._selector.register(connection, selectors.EVENT_READ, peer)

    def _watch(self) -> None:
        """Drop strangers that keep silent; have the selector look for what is to be sent."""
        for peer in [*self._strangers]:
            if time.monotonic() - peer.heard > _HANDSHAKE_TIME:
                self._drop(peer)
        for peer in [*self._strangers, *self.peers.values()]:
            if peer.has_outgoing != peer.awaits_room and not peer.gone:
                peer.awaits_room = peer.has_outgoing
                events = selectors.EVENT_READ | (selectors.EVENT_WRITE * peer.awaits_room)
                self._selector.modify(peer.connection, events, peer)

    def _read(self, peer: Peer) -> None:
        try:
            while not peer.gone:
                frame = peer.reader.read(peer.connection)
                if peer.handshake is None:
                    peer.heard = time.monotonic()
                if frame is not None:
                    self._take(peer, frame)
                if frame is None or not peer.reader.may_have_more:
                    return
        except EOFError:
            self._drop(peer)
        except ConnectionRefusedByPeerError as error:
            if peer.handshake is None:
                peer.failure = peer.failure or error
            self._drop(peer)

    def _take(self, peer: Peer, frame: Frame) -> None:
        if peer.handshake is not None:
            self._greet(peer, frame)
        elif frame.kind in self._dispatch:
            self._dispatch[frame.kind](peer, frame)
        else:
            raise ConnectionRefusedByPeerError(
                f"Client {peer.instance_id} sent {frame.kind.name}, which only a server sends."
            )

    def _greet(self, peer: Peer, frame: Frame) -> None:
        handshake = peer.handshake
        if handshake is None:
            return
        peer.send(handshake.answer(frame))
        wanted = handshake.instance_id
        if wanted is None:
            return
        free = [n for n in range(1, self._instance_nb + 1) if n not in self.peers]
        if not free or (wanted and wanted not in free):
            refusal = ConnectionRefusedByPeerError(
                f"The server has no place for instance {wanted or 'of any number'}: of its "
                f"{self._instance_nb} instances {free or 'none'} are free."
            )
            peer.send(pack(Kind.ERROR, encode_error(refusal)))
            raise refusal
        peer.handshake = None
        peer.instance_id = wanted or free[0]
        peer.reader.limit = MAX_PAYLOAD
        self._strangers.remove(peer)
        self.peers[peer.instance_id] = peer
        peer.send(pack(Kind.SETUP, self._setup(peer.instance_id)))

    def _drop(self, peer: Peer) -> None:
        if peer.gone:
            return
        peer.gone = True
        self._selector.unregister(peer.connection)
        peer.connection.close()
        if peer in self._strangers:
            self._strangers.remove(peer)

    # What clients say -----------------------------------------------------------------------

    def _ready(self, peer: Peer, frame: Frame) -> None:
        peer.fields = _decode_fields(frame)

    def _fields(self, peer: Peer, frame: Frame) -> None:
        peer.row_fields = _decode_fields(frame)

    def _rows(self, peer: Peer, frame: Frame) -> None:
        count = frame.number
        if not peer.row_fields or peer.received + count > peer.granted:
            raise ConnectionRefusedByPeerError(
                f"Client {peer.instance_id} sent rows that nobody asked for."
            )
        peer.rows.append(unpack_rows(frame.payload, peer.row_fields, count), count)
        peer.received += count

    def _error(self, peer: Peer, frame: Frame) -> None:
        peer.failure, peer.failed_row = decode_error(frame.payload), frame.number

    def _bye(self, peer: Peer, frame: Frame) -> None:
        peer.finished = True


def _decode_fields(frame: Frame) -> list[Field]:
    plain: list[dict[str, Any]] = decode(frame.payload)
    return [Field.from_dict(one) for one in plain]
