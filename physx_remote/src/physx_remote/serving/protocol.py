"""Protocol and Service: one way of driving environments from another process, chosen by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import Parameter, isabstract, signature
from typing import TYPE_CHECKING, Any, ClassVar

from physx_core import Closeable
from physx_core.errors import ConfigError, RemoteError, UnknownOptionError, listed, nearest
from physx_core.plugins import resolve

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from physx_remote.godot_gym.environment import RLEnvironment
    from physx_remote.serving.worlds import Worlds

PROTOCOLS: Mapping[str, str] = {
    "godot-gym": "physx_remote.godot_gym.protocol:GodotGym",
    "godot-rl": "physx_remote.godot_rl.protocol:GodotRL",
    "physx": "physx_remote.physx.protocol:Physx",
}
"""Names of the protocols that physx brings."""

_LAST_PORT = 0xFFFF


class Service(Closeable):
    """Environments at work for others; a context manager. Nothing happens but in calls of `poll`.

    Attributes:
        address: Host and port where it really listens, or what it is connected to.
    """

    address: tuple[str, int]

    @abstractmethod
    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived.

        Args:
            timeout: How long to wait for the first of it, in s; None: until there is something.

        Returns:
            False once it is over: closed here, or by the other side where the protocol says so.
        """

    def run(self) -> None:
        """Serve until it is over; Ctrl-C and `close` in a signal's function or thread end it."""
        try:
            while self.poll(None):
                continue
        except KeyboardInterrupt:
            return

    @abstractmethod
    def close(self) -> None:
        """End all connections; calling it again does nothing."""


class Protocol(ABC):
    """One way of driving environments from another process.

    A subclass takes its own options in the constructor, by name, and checks them.

    Attributes:
        name: What users select it by.
    """

    name: ClassVar[str]

    def __init__(self, **options: Any) -> None:
        """Refuse options that no class took.

        Raises:
            UnknownOptionError: An option that the protocol does not have.
        """
        if options:
            from physx_core.components import options_of

            owner = f'The protocol "{self.name}"'
            raise UnknownOptionError(owner, options, options_of(type(self)))

    @abstractmethod
    def service(self, worlds: Worlds | RLEnvironment, *, address: str, port: int) -> Service:
        """Return a service of the worlds, already listening or connected.

        Args:
            worlds: What is driven.
            address: Where to listen, or what to connect to.
            port: Likewise; 0: any free port, or the protocol's own.

        Raises:
            RemoteError: It cannot listen or connect there, or these worlds cannot be served so.
        """

    @classmethod
    def connect(cls, host: str, port: int, **options: Any) -> gymnasium.Env[Any, Any]:
        """Return a client of a service as a Gymnasium environment.

        Raises:
            RemoteError: The protocol has no such client, or nothing answers there.
        """
        raise RemoteError(f'The protocol "{cls.name}" has no client that is an environment.')

    @classmethod
    def connect_vector(cls, host: str, port: int, **options: Any) -> VectorEnv[Any, Any, Any]:
        """Return a client of a service as a Gymnasium vector environment.

        Raises:
            RemoteError: The protocol has no such client, or nothing answers there.
        """
        raise RemoteError(f'The protocol "{cls.name}" has no client of several worlds at once.')


def find_protocol(reference: str | type[Protocol]) -> type[Protocol]:
    """Return the protocol of a name, ``"package.module:Class"``, or the class itself.

    Raises:
        ConfigError: There is none of that name, or what the reference names is no protocol.
    """
    if isinstance(reference, str) and ":" not in reference:
        if reference not in PROTOCOLS:
            raise ConfigError(
                f'There is no protocol "{reference}".{nearest(reference, PROTOCOLS)} '
                f'There are: {listed(PROTOCOLS)}; or give "package.module:Class".'
            )
        module, _, name = PROTOCOLS[reference].partition(":")
        found = getattr(import_module(module), name)
    else:
        found = resolve("environment", reference)
    if not (isinstance(found, type) and issubclass(found, Protocol)) or isabstract(found):
        raise ConfigError(
            f"{reference} is no protocol: it must be a subclass of physx_remote.Protocol that "
            "implements service()."
        )
    return found


def check_options(owner: str, options: Mapping[str, Any], maker: Callable[..., Any]) -> None:
    """Check that all options are among those that a function or class takes by name only.

    Raises:
        UnknownOptionError: One is not.
    """
    known = [
        each.name
        for each in signature(maker).parameters.values()
        if each.kind is Parameter.KEYWORD_ONLY
    ]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise UnknownOptionError(owner, unknown, known)


def parse_address(text: str) -> tuple[str, int]:
    """Return host and port of ``"host:port"`` or ``"[::1]:port"``.

    Raises:
        ConfigError: The text has not this form.
    """
    host, _, port = text.rpartition(":") if isinstance(text, str) else ("", "", "")
    if not host or not port.isdecimal() or int(port) > _LAST_PORT:
        raise ConfigError(f'{text!r} is no address: give "host:port", such as "127.0.0.1:9090".')
    return host.strip("[]"), int(port)


def check_place(address: str, port: int) -> None:
    """Check that something may be an address and a port.

    Raises:
        ConfigError: It is not.
    """
    if not isinstance(address, str) or not address:
        raise ConfigError(f'address is {address!r} but must be a text such as "127.0.0.1".')
    if type(port) is not int or not 0 <= port <= _LAST_PORT:
        raise ConfigError(f"port is {port!r} but must be a whole number from 0 to {_LAST_PORT}.")
