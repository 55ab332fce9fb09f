"""GodotGym: JSON requests and protobuf answers, compatible with godot_gym_api."""

from __future__ import annotations

from typing import Any, ClassVar

from physx_core.errors import UsageError
from physx_remote.godot_gym.client import GodotGymEnv
from physx_remote.godot_gym.communication import Communication
from physx_remote.godot_gym.environment import RLEnvironment
from physx_remote.godot_gym.gymnasium_scene import GymnasiumScene
from physx_remote.serving.connect_options import ConnectOptions, check_names
from physx_remote.serving.protocol import Protocol, Scene
from physx_remote.serving.service import Service
from physx_remote.serving.worlds import Worlds


class GodotGym(Protocol):
    """Serves an `RLEnvironment`, or one Gymnasium environment as a `GymnasiumScene`."""

    name: ClassVar[str] = "godot-gym"

    def __init__(self, **options: Any) -> None:
        """Store the options of `Communication`; without any, an `RLEnvironment` uses its own."""
        known = Communication.__init__.__kwdefaults__ or {}
        check_names(f'The protocol "{self.name}"', options, known)
        Communication(**options)  # validates the values
        self._options = options

    def service(self, worlds: Worlds | Scene, *, address: str, port: int) -> GodotGymService:
        """Return a listening service; see `Protocol.service`."""
        environment = GymnasiumScene(worlds) if isinstance(worlds, Worlds) else worlds
        if not isinstance(environment, RLEnvironment):
            raise UsageError(f"{type(environment).__name__} is not an RLEnvironment.")
        if environment.communication.is_listening:
            raise UsageError(
                f"This {type(environment).__name__} was already served: create a new one."
            )
        if self._options:
            environment.communication.close()
            environment.communication = Communication(**self._options)
        service = GodotGymService(environment)
        try:
            environment.open()
            if not environment.communication.is_listening:
                environment.communication.start_server(port, address)
        except BaseException:
            service.close()
            raise
        return service

    @classmethod
    def connect(cls, host: str, port: int, **options: Any) -> GodotGymEnv:
        """Return a client; the options are those of `GodotGymEnv`."""
        own = GodotGymEnv.__init__.__kwdefaults__ or {}
        check_names("A client of godot-gym", options, [*own, *ConnectOptions.__annotations__])
        return GodotGymEnv((host, port), **options)


class GodotGymService(Service):
    """Serves an `RLEnvironment`; closing the service closes the environment.

    Attributes:
        environment: The environment.
    """

    def __init__(self, environment: RLEnvironment) -> None:
        """Store the environment."""
        self.environment = environment

    @property
    def address(self) -> tuple[str, int]:  # type: ignore[override]
        """Host and port at which it listens."""
        return self.environment.communication.address

    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived; see `Service.poll`."""
        return self.environment._process(timeout)

    def close(self) -> None:
        """Close all connections and the environment."""
        self.environment.close()
