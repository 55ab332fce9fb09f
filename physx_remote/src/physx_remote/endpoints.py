"""`serve`, `connect` and `connect_vector`: a protocol by name brought to life."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from physx_core.errors import ConfigError, UsageError
from physx_core.net import check_address, parse_address
from physx_core.plugins import resolve
from physx_remote.serving.protocol import Protocol, find_protocol
from physx_remote.serving.service import Service
from physx_remote.serving.worlds import GYMNASIUM, called, open_worlds

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from physx_remote.godot_gym.environment import RLEnvironment


def serve(
    environment: Any,
    protocol: str | type[Protocol] = "physx",
    *,
    address: str = "127.0.0.1",
    port: int = 0,
    num_worlds: int = 1,
    env_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> Service:
    """Return a service of an environment; call its `run`, or `poll` again and again.

    Args:
        environment: An `RLEnvironment`, its class or reference; or what
            `physx_remote.open_worlds` takes.
        protocol: Name of the protocol, ``"package.module:Class"``, or the class.
        address: Where to listen, or what to connect to.
        port: Likewise; 0: any free port, or the protocol's own.
        num_worlds: How many worlds to serve on one connection.
        env_kwargs: Keyword arguments of each environment.
        options: The protocol's own options.

    Raises:
        PhysxError: There is no such environment or protocol, or it cannot listen there.
    """
    check_address(address, port)
    if env_kwargs is not None and not isinstance(env_kwargs, Mapping):
        raise ConfigError(f"env_kwargs is {env_kwargs!r} but must be a dictionary.")
    kind = find_protocol(protocol)(**options)
    scene = _scene(environment, env_kwargs or {})
    if scene is None:
        worlds = open_worlds(environment, num_worlds, env_kwargs)
        try:
            return kind.service(worlds, address=address, port=port)
        except BaseException:
            worlds.close()
            raise
    if num_worlds != 1:
        raise UsageError(f"An RLEnvironment is one world, and num_worlds is {num_worlds}.")
    return kind.service(scene, address=address, port=port)


def connect(
    address: str, protocol: str | type[Protocol] = "physx", **options: Any
) -> gymnasium.Env[Any, Any]:
    """Return a service's environment, driven from here.

    Args:
        address: ``"host:port"``.
        protocol: See `serve`.
        options: The options of the protocol's client.

    Raises:
        PhysxError: Nothing answers there, or not what was expected.
    """
    return find_protocol(protocol).connect(*parse_address(address), **options)


def connect_vector(
    address: str, protocol: str | type[Protocol] = "physx", **options: Any
) -> VectorEnv[Any, Any, Any]:
    """Return a service's worlds, driven from here together; see `connect`."""
    return find_protocol(protocol).connect_vector(*parse_address(address), **options)


def _scene(environment: Any, arguments: Mapping[str, Any]) -> RLEnvironment | None:
    """Return the `RLEnvironment` that is meant, or None for what is of another kind."""
    from physx_remote.godot_gym.environment import RLEnvironment

    if isinstance(environment, str) and not environment.startswith(GYMNASIUM):
        if ":" not in environment:
            return None
        environment = resolve("environment", environment)
    if inspect.isclass(environment) and issubclass(environment, RLEnvironment):
        environment = called(environment, arguments)
    elif arguments and isinstance(environment, RLEnvironment):
        raise UsageError(
            f"{type(environment).__name__} is made already and takes no env_kwargs: give the class."
        )
    if not isinstance(environment, RLEnvironment):
        return None
    if not hasattr(environment, "communication"):
        raise UsageError(f"{type(environment).__name__}.__init__ must call super().__init__().")
    return environment
