"""PhysxService: serves worlds over the protocol physx."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from physx_core import PhysxError
from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.net import (
    HANDSHAKE_LIMIT,
    SOCKETS,
    Frame,
    FrameReader,
    Handshakes,
    Kind,
    Reader,
    Transport,
    decode,
    describe_flat,
    encode_error,
    pack,
    pack_header,
    pack_value,
)
from physx_core.typing import Array
from physx_remote.errors import RemoteError, RequestError
from physx_remote.physx.wire import (
    ACT,
    COUNT,
    IS_RESET,
    OBSERVE,
    SERVICE,
    VERSION,
    WORLDS,
    encode_infos,
)
from physx_remote.physx.world_requests import Change, WorldRequests, wrap_error
from physx_remote.serving.connection import RequestConnection
from physx_remote.serving.socket_service import SocketService, Work
from physx_remote.serving.spaces import describe_space
from physx_remote.serving.worlds import Worlds

_BACKLOG = 1 << 16
_LARGE = 1 << 15
_MOST_PARTS = 512  # a system call accepts at most 1024


class PhysxService(SocketService):
    """Serves worlds to one acting client and to observers. Closing it closes the worlds.

    Attributes:
        token: The token that clients must know.
    """

    encrypts: ClassVar[bool] = True

    def __init__(
        self,
        worlds: Worlds,
        token: str,
        *,
        handshake_timeout: float,
        max_request: int,
        max_clients: int,
        max_snapshots: int,
        transport: Transport = SOCKETS,
    ) -> None:
        """Store the worlds; the options are those of `Physx`."""
        super().__init__(max_clients=max_clients, transport=transport)
        self.token = token
        self._worlds = worlds
        self._requests = WorldRequests(worlds, max_snapshots, self._clock)
        self._introduction = self._introduce()
        self._max_request = max_request
        self._handshake_timeout = handshake_timeout
        self._open()
        self._actor: RequestConnection | None = None
        self._observers: dict[RequestConnection, bool] = {}  # whether a change was skipped
        self._seen = 0

    def _release(self) -> None:
        """Also close the worlds, once no request is in progress."""
        super()._release()
        self._worlds.close()

    def _introduce(self) -> dict[str, Any]:
        worlds = self._worlds
        first = worlds.environments[0]
        modes = first.metadata.get("render_modes", [])
        return {
            "service": SERVICE,
            "version": VERSION,
            "name": worlds.name,
            "observation_space": describe_space(worlds.observation_space),
            "action_space": describe_space(worlds.action_space),
            "num_worlds": worlds.num_worlds,
            "snapshot": worlds.has_snapshots,
            "render_mode": first.render_mode,
            "render_modes": [str(mode) for mode in modes],
            "render_fps": _number(first.metadata.get("render_fps")),
        }

    # Events of the loop -----------------------------------------------------------------------

    def new_reader(self) -> Reader:
        """Return a reader of frames."""
        return FrameReader(HANDSHAKE_LIMIT)

    def new_pending(self) -> Handshakes[RequestConnection]:
        """Return the handshakes, in which new clients prove that they know the token."""
        self._handshakes = Handshakes[RequestConnection](
            self.token,
            self._handshake_timeout,
            self.max_pending,
            self.drop,
            self._listener.timers,
        )
        return self._handshakes

    def on_first_message(self, connection: RequestConnection) -> None:
        """Do nothing: the handshake decides who is a client."""

    def on_close(self, connection: RequestConnection) -> None:
        """Forget a client; the worlds keep their state."""
        self._observers.pop(connection, None)
        if connection is self._actor:
            self.log.info(connection.name, "%s no longer acts", connection.name)
            self._actor = None
            self._requests.forget_snapshots()

    def on_drain(self, connection: RequestConnection) -> None:
        """Send the latest state to an observer that did not keep up."""
        if self._observers.get(connection):
            self._observers[connection] = False
            self.send(connection, self._latest(Kind.SEEN, self._seen))

    def handle(self, connection: RequestConnection, body: Frame) -> Work | None:
        """Handle one frame."""
        kind, number, payload = body
        if connection in self._handshakes:
            self._greet(connection, body)
            return None
        try:
            if kind is Kind.ACTIONS and connection is self._actor:
                steps = self._requests.steps(_arrays(decode(payload)))
                return self._finish(connection, number, steps)
            if kind is not Kind.REQUEST:
                raise RequestError("Only the acting client may step.")
            return self._carry_out(connection, number, decode(payload))
        except ConnectionRefusedByPeerError as error:
            self.drop(connection, str(error))
        except Exception as error:
            self._refuse(connection, number, error)
        return None

    # Handshake ------------------------------------------------------------------------------

    def _greet(self, connection: RequestConnection, frame: Frame) -> None:
        """Continue the handshake."""
        try:
            answer, role = self._handshakes.greet(connection, frame)
        except ConnectionRefusedByPeerError as error:
            self.drop(connection, str(error))
            return
        if role is None:
            self.send(connection, answer)
            return
        if isinstance(connection.reader, FrameReader):
            connection.reader.limit = self._max_request
        try:
            self._admit(connection, role)
        except RemoteError as error:
            self.send(connection, pack(Kind.ERROR, encode_error(error)))
            self.drop(connection, f"turned away: {error}")
            return
        self.send(connection, pack_value(Kind.SETUP, self._introduction, "introduction"))

    def _admit(self, connection: RequestConnection, role: int) -> None:
        """Assign a client its role."""
        self.welcome(connection)
        if role == OBSERVE:
            self.log.info(connection.name, "%s observes", connection.name)
            connection.limit_backlog(_BACKLOG)
            self._observers[connection] = False
            return
        if role != ACT:
            raise RemoteError(
                "This is a service of environments, not the server of a run: connect with "
                "physx_remote.connect."
            )
        actor = self._actor
        if actor is not None and not actor.ended:
            raise RemoteError(
                f"{actor.name} acts here already; only one client may act at a time. Try again "
                "when it has left, or observe with physx_remote.PhysxObserver."
            )
        if actor is not None:
            self.drop(actor)
        self.log.info(connection.name, "%s acts", connection.name)
        self._actor = connection

    # Requests -------------------------------------------------------------------------------

    def _carry_out(self, connection: RequestConnection, number: int, request: Any) -> Work | None:
        """Carry out a request; return the remaining work if it is not completed immediately."""
        if not isinstance(request, dict):
            raise RequestError("A request must be a dictionary.")
        what = request.get("do")
        if not isinstance(what, str):
            raise RequestError(f'"do" must be the name of a request, not {what!r:.60}.')
        if what == "last":
            self.send(connection, self._latest(Kind.ANSWER, number))
            return None
        if connection is not self._actor:
            raise RequestError(f'An observer may only request "last", not "{what}".')
        if what == "reset":
            return self._finish(connection, number, self._requests.resets(request))
        if what == "restore":
            world = self._requests.restore(request)
            self._publish(connection, number, Change([world], is_reset=True))
            return None
        answer = self._requests.answer(what, request)
        self.send(connection, pack_value(Kind.ANSWER, answer, f'The answer to "{what}"', number))
        return None

    def _finish(self, connection: RequestConnection, number: int, change: Change) -> Work:
        """Change the worlds, and answer the request."""
        try:
            for wait in change.work:
                yield wait
                if connection.closed:
                    name = connection.name
                    self.log.info(name, "%s left in the middle of a request", name)
                    return
            self._publish(connection, number, change)
        except Exception as error:
            self._refuse(connection, number, error)

    def _refuse(self, connection: RequestConnection, number: int, error: Exception) -> None:
        """Report an error in the log and to the client."""
        told, name = error if isinstance(error, PhysxError) else wrap_error(error), connection.name
        cause = error if error is not told or error.__cause__ is not None else None
        self.log.error(name, "A request from %s failed: %s", name, told, cause=cause)
        self.send(connection, pack(Kind.REFUSAL, encode_error(told), number))

    # Answers --------------------------------------------------------------------------------

    def _publish(self, connection: RequestConnection, number: int, change: Change) -> None:
        """Answer with the change in the worlds, and send it to the observers."""
        latest = self._requests.latest
        rows = latest.rows(change.worlds)
        infos = [latest.infos[world] for world in change.worlds]
        notes = encode_infos(infos) if any(infos) else b""
        self.send(connection, *_message(Kind.ANSWER, number, notes, rows))
        self._seen += 1
        if not self._observers:
            return
        shown: dict[str, Array | np.generic] = {
            WORLDS: np.array(change.worlds, np.int64),
            IS_RESET: np.bool_(change.is_reset),
            **rows,
            **change.actions,
        }
        message = b"".join(_message(Kind.SEEN, self._seen, notes, shown))
        for observer in [*self._observers]:
            if observer.outgoing:
                self._observers[observer] = True
            else:
                self.send(observer, message)

    def _latest(self, kind: Kind, number: int) -> bytes:
        """Return a message with the latest state of all worlds."""
        latest = self._requests.latest
        worlds = np.flatnonzero(latest.known)
        rows = latest.rows(worlds.tolist())
        infos = [latest.infos[world] for world in worlds]
        notes = encode_infos(infos) if any(infos) else b""
        shown: dict[str, Array | np.generic] = {
            WORLDS: worlds.astype(np.int64),
            IS_RESET: np.bool_(False),
            COUNT: np.int64(self._seen),
            **rows,
        }
        return b"".join(_message(kind, number, notes, shown))


def _message(
    kind: Kind, number: int, notes: bytes, arrays: Mapping[str, Array | np.generic]
) -> Sequence[bytes | memoryview]:
    """Return a message in parts; long arrays are not copied."""
    first = pack(Kind.NOTES, notes, number) if notes else b""
    whole = dict(arrays)
    prefix, length = describe_flat(whole)
    if length < _LARGE or len(whole) > _MOST_PARTS:
        message = pack_value(kind, whole, "observations", number)
        return [first + message]
    opening = first + pack_header(kind, length, number) + prefix
    return [opening, *(np.ascontiguousarray(array).data for array in whole.values())]


def _arrays(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RequestError("Actions must be a dictionary of arrays.")
    return value


def _number(value: Any) -> float | None:
    with contextlib.suppress(TypeError, ValueError):
        return float(value)
    return None
