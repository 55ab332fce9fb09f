"""GodotRL: the protocol of godot_rl_agents; the service is the application that a trainer drives.

The trainer listens and the application connects to it. Each message is a 4-byte length followed by
a JSON object with a ``type``. Each agent of the trainer is one world.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time
from typing import Any, ClassVar

from physx_core.errors import ActionError, ConfigError, PhysxError, listed
from physx_remote.errors import RemoteError, RemoteProtocolError, RequestError
from physx_remote.godot_rl.agents import Agents, Answer
from physx_remote.godot_rl.client import GodotRLEnv, GodotRLVectorEnv
from physx_remote.serving.connect_options import ConnectOptions, check_names
from physx_remote.serving.connection import RequestConnection
from physx_remote.serving.framing import MAX_REQUEST, PrefixReader, add_prefix
from physx_remote.serving.protocol import Protocol, Scene
from physx_remote.serving.service import LOG, Service
from physx_remote.serving.socket_service import SocketService, Work
from physx_remote.serving.worlds import Worlds

PORT = 11008
"""Default port of trainers."""

MAJOR_VERSION = "0"
"""Major version of the implemented protocol."""

_JSON = json.JSONEncoder(separators=(",", ":"), check_circular=False)

_RETRY = 0.05


class GodotRL(Protocol):
    """Serves worlds to a trainer of godot_rl_agents."""

    name: ClassVar[str] = "godot-rl"

    def __init__(
        self,
        *,
        action_repeat: int = 1,
        seed: int | None = None,
        timeout: float = 60.0,
        max_request: int = MAX_REQUEST,
        **options: Any,
    ) -> None:
        """Validate the options.

        Args:
            action_repeat: Environment steps per step of the trainer; rewards are summed, and the
                end of an episode ends the step.
            seed: Seed of the first episodes: world 0 gets the seed itself, the others get seeds
                derived from it. None: unseeded.
            timeout: Time in s to keep trying to reach the trainer.
            max_request: Longest accepted message in bytes.
            options: Must be empty.
        """
        super().__init__(**options)
        sizes = {"action_repeat": action_repeat, "max_request": max_request}
        for option, value in sizes.items():
            if type(value) is not int or value < 1:
                raise ConfigError(f"{option} is {value!r} but must be a positive integer.")
        if seed is not None and (type(seed) is not int or seed < 0):
            raise ConfigError(f"seed is {seed!r} but must be a non-negative integer or None.")
        if type(timeout) not in (int, float) or not timeout >= 0:
            raise ConfigError(
                f"timeout is {timeout!r} but must be a non-negative number of seconds."
            )
        self.action_repeat, self.seed = action_repeat, seed
        self.timeout, self.max_request = timeout, max_request

    def service(
        self, worlds: Worlds | Scene, *, address: str = "127.0.0.1", port: int = 0
    ) -> Service:
        """Connect to a trainer and return the service of the worlds.

        Args:
            worlds: One world per agent of the trainer.
            address: Address where the trainer listens.
            port: Port where the trainer listens; 0: 11008.
        """
        if not isinstance(worlds, Worlds):
            raise RemoteError(
                f'The protocol "{self.name}" serves Gymnasium and physx environments, whose spaces '
                f"are known; {type(worlds).__name__} is neither."
            )
        agents = Agents(worlds, self.action_repeat, self.seed)
        trainer = _connect_to_trainer(address, port or PORT, self.timeout)
        try:
            return _GodotRLService(worlds, agents, trainer, self.max_request)
        except OSError as error:  # the trainer has disconnected
            trainer.close()
            raise RemoteError(f"The trainer at {address} disconnected at once: {error}.") from error

    @classmethod
    def connect(cls, host: str, port: int, **options: Any) -> GodotRLEnv:
        """Wait for an application with one agent: see `GodotRLEnv`."""
        check_names("A client of godot-rl", options, ConnectOptions.__annotations__)
        return GodotRLEnv((host, port or PORT), **options)

    @classmethod
    def connect_vector(cls, host: str, port: int, **options: Any) -> GodotRLVectorEnv:
        """Wait for an application with any number of agents: see `GodotRLVectorEnv`."""
        check_names("A client of godot-rl", options, ConnectOptions.__annotations__)
        return GodotRLVectorEnv((host, port or PORT), **options)


def _connect_to_trainer(address: str, port: int, timeout: float) -> socket.socket:
    """Return a socket connected to a trainer, which may start listening a little later."""
    deadline = time.monotonic() + timeout
    while True:
        left = max(deadline - time.monotonic(), _RETRY)
        try:
            trainer = socket.create_connection((address, port), timeout=left)
        except (socket.gaierror, OverflowError, UnicodeError) as error:
            raise RemoteError(f"{address} port {port} is not a valid address: {error}.") from error
        except OSError as error:
            reason: OSError | None = error
        else:
            if not _met_itself(trainer):
                return trainer
            trainer.close()
            reason = None
        if time.monotonic() + _RETRY > deadline:
            raise RemoteError(
                f"No godot-rl trainer is listening at {address} port {port}, after {timeout:g} s "
                f"of trying ({reason}). In godot-rl, the trainer listens and the environment "
                f"connects: start the trainer first, for example GodotEnv(port={port}), or have it "
                "start the environment, with a launcher file as its env_path."
            ) from reason
        time.sleep(_RETRY)


def _met_itself(connected: socket.socket) -> bool:
    """Return whether a socket is connected to itself: its own port happens to be the target."""
    with contextlib.suppress(OSError):
        return bool(connected.getsockname() == connected.getpeername())
    return False


class _GodotRLService(SocketService):
    """Serves agents to a trainer; ends when the trainer closes it or disconnects."""

    def __init__(
        self, worlds: Worlds, agents: Agents, trainer: socket.socket, max_request: int
    ) -> None:
        """Store the worlds, and serve the trainer's connection."""
        super().__init__()
        self._worlds, self._agents = worlds, agents
        self._max_request = max_request
        self.adopt(trainer)
        self.address = trainer.getpeername()[:2]

    def new_reader(self) -> PrefixReader:
        """Return a reader of messages."""
        return PrefixReader(self._max_request)

    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived; see `Service.poll`."""
        goes_on = super().poll(timeout)
        if not goes_on:
            self._worlds.close()
        return goes_on

    def close(self) -> None:
        """Close the connection and the worlds, after the current request."""
        super().close()
        if self._released:
            self._worlds.close()

    def on_close(self, connection: RequestConnection) -> None:
        """End when the trainer disconnects."""
        self.log.info(connection.name, "The trainer at %s has disconnected", connection.name)
        self.close()

    def on_fault(self, connection: RequestConnection, error: PhysxError) -> None:
        """End with the error, which is not reported to the trainer."""
        super().on_fault(connection, error)
        raise RemoteError(f"The trainer at {connection.name} is lost: {error}") from error

    def handle(self, connection: RequestConnection, body: bytes) -> Work | None:
        """Handle one message."""
        try:
            message = _parse_message(body)
            if message["type"] == "close":
                self.close()
                return None
            if message["type"] == "handshake":
                _check_version(message)
                return None
            request = self._agents.requests.get(message["type"])
            if request is None:
                known = [*self._agents.requests, "close", "handshake"]
                raise RequestError(
                    f'Unknown message type "{message["type"]}". Known: {listed(known)}.'
                )
        except RemoteError as error:
            self._refuse(connection, error)
            return None
        return self._reply(connection, request(message))

    def _reply(self, connection: RequestConnection, answer: Answer) -> Work:
        """Send the answer to a request, or its error."""
        try:
            told = yield from answer
        except Exception as error:  # the environment's own code may raise anything
            self._refuse(connection, error)
        else:
            self._send(connection, told)

    def _refuse(self, connection: RequestConnection, error: Exception) -> None:
        """Report an error in the log and to the trainer, which exits at the unknown message."""
        text = "; ".join([str(error), *getattr(error, "__notes__", [])])
        is_foreign = not isinstance(error, (RemoteError, ActionError))
        cause = error if is_foreign else None
        self.log.error(connection.name, "The trainer's request failed: %s", text, cause=cause)
        name = type(error).__name__
        self._send(connection, {"type": "error", "error": name, "message": text})

    def _send(self, connection: RequestConnection, answer: dict[str, Any]) -> None:
        self.send(connection, add_prefix(_JSON.encode(answer).encode("utf-8")))


def _parse_message(body: bytes) -> dict[str, Any]:
    try:
        message = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise RemoteProtocolError(
            f"A message is not valid JSON: {str(error)[:200]}. It begins with {body[:80]!r}."
        ) from None
    if not isinstance(message, dict) or not isinstance(message.get("type"), str):
        raise RemoteProtocolError(
            f'A message must be a JSON object with a string "type", not {body[:80]!r}.'
        )
    return message


def _check_version(message: dict[str, Any]) -> None:
    version = f"{message.get('major_version')}.{message.get('minor_version')}"
    if str(message.get("major_version")) != MAJOR_VERSION:
        LOG.warning(
            "The trainer uses version %s of godot-rl's protocol; physx implements %s.x",
            version,
            MAJOR_VERSION,
        )
