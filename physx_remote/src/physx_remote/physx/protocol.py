"""Physx: an authenticated protocol with typed arrays, several worlds per connection, observers."""

from __future__ import annotations

import secrets
from typing import Any, ClassVar

from physx_core.checks import positive
from physx_core.errors import ConfigError, UsageError
from physx_core.net import MAX_PAYLOAD, find_token
from physx_remote.physx.client import PhysxClient, PhysxEnv
from physx_remote.physx.service import PhysxService
from physx_remote.physx.vector_env import PhysxVectorEnv
from physx_remote.serving.connect_options import TokenOptions, check_names
from physx_remote.serving.framing import MAX_REQUEST
from physx_remote.serving.protocol import Protocol, Scene
from physx_remote.serving.worlds import Worlds


class Physx(Protocol):
    """Serves worlds to one acting client and any number of observers.

    Both sides prove that they know a token. A request is answered with its result, or with the
    error and its traceback; the worlds keep running, and keep their state when a client leaves.
    """

    name: ClassVar[str] = "physx"

    def __init__(
        self,
        *,
        token: str | None = None,
        token_file: str | None = None,
        handshake_timeout: float = 10.0,
        max_request: int = MAX_REQUEST,
        max_clients: int = 256,
        max_snapshots: int = 256,
        **options: Any,
    ) -> None:
        """Store the options.

        Args:
            token: Secret that clients must know, at least 16 characters. None: the content of
                `token_file`, else the environment variable ``PHYSX_TOKEN``, else a random one,
                `PhysxService.token`.
            token_file: File with the token, readable only by its owner.
            handshake_timeout: Time in s in which a client must prove that it knows the token.
            max_request: Longest request in bytes; clients that send longer ones are disconnected.
            max_clients: Maximum number of clients; further ones get an error. In addition, as many
                connections that have not proved that they know the token are kept, but at least 32;
                if another arrives, one of them is closed.
            max_snapshots: Maximum number of snapshots.
            options: Must be empty.
        """
        super().__init__(**options)
        positive("handshake_timeout", handshake_timeout)
        if type(max_request) is not int or not 1 <= max_request <= MAX_PAYLOAD:
            raise ConfigError(f"max_request is {max_request!r} but must be in 1 .. {MAX_PAYLOAD}.")
        for option, value in (("max_clients", max_clients), ("max_snapshots", max_snapshots)):
            if type(value) is not int or value < 1:
                raise ConfigError(f"{option} is {value!r} but must be an integer of at least 1.")
        found = find_token(token_file, token)
        self.token = secrets.token_hex(32) if found is None else found
        self._options: dict[str, Any] = {
            "handshake_timeout": handshake_timeout,
            "max_request": max_request,
            "max_clients": max_clients,
            "max_snapshots": max_snapshots,
        }

    def service(self, worlds: Worlds | Scene, *, address: str, port: int) -> PhysxService:
        """Return a listening service; see `Protocol.service`."""
        if not isinstance(worlds, Worlds):
            raise UsageError(
                f"{type(worlds).__name__} is an RLEnvironment, which need not define spaces: "
                'serve it with the protocol "godot-gym".'
            )
        service = PhysxService(worlds, self.token, **self._options)
        try:
            service.listen(address, port)
        except BaseException:
            service.close()
            raise
        return service

    @classmethod
    def connect(cls, host: str, port: int, *, world: int = 0, **options: Any) -> PhysxEnv:
        """Return one world of a service.

        Args:
            host: Host of the service.
            port: Port of the service.
            world: Number of the world.
            options: See `TokenOptions`.
        """
        client = cls._client(host, port, options, "world")
        try:
            return PhysxEnv(client, world)
        except BaseException:
            client.close()
            raise

    @classmethod
    def connect_vector(
        cls, host: str, port: int, *, autoreset_mode: Any = "NextStep", **options: Any
    ) -> PhysxVectorEnv:
        """Return all worlds of a service.

        Args:
            host: Host of the service.
            port: Its port.
            autoreset_mode: What happens after the end of an episode: see `PhysxVectorEnv`.
            options: See `TokenOptions`.
        """
        client = cls._client(host, port, options, "autoreset_mode")
        try:
            return PhysxVectorEnv(client, autoreset_mode=autoreset_mode)
        except BaseException:
            client.close()
            raise

    @staticmethod
    def _client(host: str, port: int, options: dict[str, Any], *own: str) -> PhysxClient:
        check_names("A client of physx", options, [*own, *TokenOptions.__annotations__])
        return PhysxClient((host, port), **options)
