"""Protocol: a way of driving environments from another process, selected by name."""

from __future__ import annotations

import typing
from abc import ABC, abstractmethod
from inspect import isabstract
from typing import TYPE_CHECKING, Any, ClassVar

from physx_core.errors import ConfigError, UnknownOptionError
from physx_core.plugins import complete_reference, find
from physx_remote.errors import RemoteError

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from physx_remote.serving.service import Service
    from physx_remote.serving.worlds import Worlds

KIND = "protocol"
"""The kind of component."""


class Scene(typing.Protocol):
    """What a protocol may serve other than `Worlds`: an `RLEnvironment`, which answers requests."""

    def open(self) -> object:
        """Prepare the agent, world and simulation."""

    def close(self) -> None:
        """Close all connections and the simulation."""


class Protocol(ABC):
    """One way of driving environments from another process.

    A subclass takes its own options as keyword arguments of the constructor and validates them.

    Attributes:
        name: The name by which users select it.
    """

    name: ClassVar[str]

    def __init__(self, **options: Any) -> None:
        """Reject options that no subclass accepted.

        Raises:
            UnknownOptionError: If there are any.
        """
        if options:
            from physx_core.components import options_of

            owner = f'The protocol "{self.name}"'
            raise UnknownOptionError(owner, options, options_of(type(self)))

    @abstractmethod
    def service(self, worlds: Worlds | Scene, *, address: str, port: int) -> Service:
        """Return a service of the worlds, already listening or connected.

        Args:
            worlds: The environments to serve.
            address: Address to listen at, or to connect to.
            port: Port to listen at or connect to; 0: any free port, or the protocol's default.

        Raises:
            RemoteError: If it cannot listen or connect there.
            UsageError: If the protocol cannot serve these environments.
        """

    @classmethod
    def connect(cls, host: str, port: int, **options: Any) -> gymnasium.Env[Any, Any]:
        """Return a client of a service as a Gymnasium environment.

        Raises:
            RemoteError: If the protocol has no such client, or nothing answers there.
        """
        raise RemoteError(f'The protocol "{cls.name}" has no client for a single environment.')

    @classmethod
    def connect_vector(cls, host: str, port: int, **options: Any) -> VectorEnv[Any, Any, Any]:
        """Return a client of a service as a Gymnasium vector environment.

        Raises:
            RemoteError: If the protocol has no such client, or nothing answers there.
        """
        raise RemoteError(f'The protocol "{cls.name}" has no client for several worlds at once.')


def find_protocol(reference: str | type[Protocol]) -> type[Protocol]:
    """Return the protocol for a name, a reference, or the class itself.

    Raises:
        ComponentNotFoundError: If there is none of that name.
        ConfigError: If it is no protocol.
    """
    found = find(KIND, complete_reference(KIND, reference))
    if not (isinstance(found, type) and issubclass(found, Protocol)) or isabstract(found):
        raise ConfigError(
            f"{reference} is not a protocol: it must be a subclass of physx_remote.Protocol that "
            "implements service()."
        )
    return found
