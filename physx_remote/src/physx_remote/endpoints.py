"""`serve`, `connect` and `connect_vector`: environments in other processes, by protocol."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, overload

from physx_core.errors import ConfigError, UsageError
from physx_core.net import check_address, parse_address
from physx_core.plugins import find
from physx_remote.serving.protocol import Protocol, find_protocol
from physx_remote.serving.service import Service
from physx_remote.serving.worlds import call_with, is_gymnasium_id, open_worlds

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.vector import VectorEnv

    from physx_remote.godot_gym.client import GodotGymEnv
    from physx_remote.godot_gym.environment import RLEnvironment
    from physx_remote.godot_rl.client import GodotRLEnv, GodotRLVectorEnv
    from physx_remote.physx.client import PhysxEnv
    from physx_remote.physx.service import PhysxService
    from physx_remote.physx.vector_env import PhysxVectorEnv


@overload
def serve(
    environment: Any,
    protocol: Literal["physx"] = "physx",
    *,
    address: str = "127.0.0.1",
    port: int = 0,
    num_worlds: int = 1,
    env_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> PhysxService: ...


@overload
def serve(
    environment: Any,
    protocol: str | type[Protocol],
    *,
    address: str = "127.0.0.1",
    port: int = 0,
    num_worlds: int = 1,
    env_kwargs: Mapping[str, Any] | None = None,
    **options: Any,
) -> Service: ...


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
    """Return a service of an environment; call its `run`, or its `poll` repeatedly.

    Args:
        environment: An `RLEnvironment`, its class or reference; or anything that
            `physx_remote.open_worlds` takes.
        protocol: Name of the protocol, ``"package.module:Class"``, or the class.
        address: Address to listen at, or to connect to.
        port: Port to listen at or connect to; 0: any free port, or the protocol's default.
        num_worlds: Number of worlds to serve on one connection.
        env_kwargs: Keyword arguments of each environment.
        options: The protocol's own options.

    Raises:
        PhysxError: If the environment or protocol does not exist, or the service cannot listen.
    """
    check_address(address, port)
    if env_kwargs is not None and not isinstance(env_kwargs, Mapping):
        raise ConfigError(f"env_kwargs is {env_kwargs!r} but must be a dictionary.")
    kind = find_protocol(protocol)(**options)
    scene = _find_scene(environment, env_kwargs or {})
    if scene is None:
        worlds = open_worlds(environment, num_worlds, env_kwargs)
        try:
            return kind.service(worlds, address=address, port=port)
        except BaseException:
            worlds.close()
            raise
    if num_worlds != 1:
        raise UsageError(f"An RLEnvironment is one world, but num_worlds is {num_worlds}.")
    return kind.service(scene, address=address, port=port)


@overload
def connect(address: str, protocol: Literal["physx"] = "physx", **options: Any) -> PhysxEnv: ...
@overload
def connect(address: str, protocol: Literal["godot-gym"], **options: Any) -> GodotGymEnv: ...
@overload
def connect(address: str, protocol: Literal["godot-rl"], **options: Any) -> GodotRLEnv: ...
@overload
def connect(
    address: str, protocol: str | type[Protocol], **options: Any
) -> gymnasium.Env[Any, Any]: ...


def connect(
    address: str, protocol: str | type[Protocol] = "physx", **options: Any
) -> gymnasium.Env[Any, Any]:
    """Return a client of a service as a Gymnasium environment.

    Args:
        address: ``"host:port"``.
        protocol: See `serve`.
        options: Options of the protocol's client.

    Raises:
        PhysxError: If nothing answers there, or the answer violates the protocol.
    """
    return find_protocol(protocol).connect(*parse_address(address), **options)


@overload
def connect_vector(
    address: str, protocol: Literal["physx"] = "physx", **options: Any
) -> PhysxVectorEnv: ...
@overload
def connect_vector(
    address: str, protocol: Literal["godot-rl"], **options: Any
) -> GodotRLVectorEnv: ...
@overload
def connect_vector(
    address: str, protocol: str | type[Protocol], **options: Any
) -> VectorEnv[Any, Any, Any]: ...


def connect_vector(
    address: str, protocol: str | type[Protocol] = "physx", **options: Any
) -> VectorEnv[Any, Any, Any]:
    """Return a client of all worlds of a service as a vector environment; see `connect`."""
    return find_protocol(protocol).connect_vector(*parse_address(address), **options)


def _find_scene(environment: Any, arguments: Mapping[str, Any]) -> RLEnvironment | None:
    """Return the `RLEnvironment` to serve, or None for other kinds of environments."""
    from physx_remote.godot_gym.environment import RLEnvironment

    if isinstance(environment, str):
        if ":" not in environment or is_gymnasium_id(environment):
            return None
        environment = find("environment", environment)
    if inspect.isclass(environment) and issubclass(environment, RLEnvironment):
        environment = call_with(environment, arguments)
    elif arguments and isinstance(environment, RLEnvironment):
        raise UsageError(
            f"This {type(environment).__name__} already exists and takes no env_kwargs: pass "
            "its class."
        )
    if not isinstance(environment, RLEnvironment):
        return None
    if not hasattr(environment, "communication"):
        raise UsageError(f"{type(environment).__name__}.__init__ must call super().__init__().")
    return environment
