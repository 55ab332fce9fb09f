"""godot-gym: requests as JSON, answers as protobuf, as godot_gym_api has them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces

from physx_core import Field
from physx_core.errors import RequestError, UnknownOptionError, UsageError
from physx_remote.godot_gym.agent import RLAgent
from physx_remote.godot_gym.communication import Communication
from physx_remote.godot_gym.environment import RLEnvironment, Stepping
from physx_remote.godot_gym.messages import Messages, fill
from physx_remote.godot_gym.world import RLEnvWorld
from physx_remote.serving.plain import plain
from physx_remote.serving.protocol import Protocol, Service, check_options
from physx_remote.serving.spaces import Space, from_json, leaves
from physx_remote.serving.worlds import Worlds

if TYPE_CHECKING:
    from physx_remote.godot_gym.client import GodotGymEnv

OBSERVATION = "observation"
OUTCOME = {"reward": float, "terminated": bool, "truncated": bool, "info": str}
"""Fields of the world's data of every Gymnasium environment; `info` is text of JSON."""


class GodotGym(Protocol):
    """Serves an `RLEnvironment`, or one Gymnasium environment as `GymnasiumScene`."""

    name: ClassVar[str] = "godot-gym"

    def __init__(self, **options: Any) -> None:
        """Keep the options of `Communication`; without any an `RLEnvironment` uses its own.

        Raises:
            UnknownOptionError: An option that `Communication` does not have.
            ConfigError: A value that it does not take.
        """
        known = Communication.__init__.__kwdefaults__ or {}
        if not options.keys() <= known.keys():
            unknown = options.keys() - known.keys()
            raise UnknownOptionError(f'The protocol "{self.name}"', unknown, known)
        Communication(**options)  # checks the values
        self._options = options

    def service(self, worlds: Worlds | RLEnvironment, *, address: str, port: int) -> Service:
        """Return a service that listens; see `Protocol.service`.

        Raises:
            UsageError: There are several worlds, or the environment is served already.
            RemoteError: It cannot listen there.
        """
        environment = worlds if isinstance(worlds, RLEnvironment) else GymnasiumScene(worlds)
        if environment.communication.is_listening:
            raise UsageError(
                f"This {type(environment).__name__} is or was served already: make another one."
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
        from physx_remote.godot_gym.client import GodotGymEnv

        check_options("A client of godot-gym", options, GodotGymEnv)
        return GodotGymEnv((host, port), **options)


class GodotGymService(Service):
    """An `RLEnvironment` at work; closing the service closes the environment."""

    def __init__(self, environment: RLEnvironment) -> None:
        """Keep the environment."""
        self.environment = environment

    @property
    def address(self) -> tuple[str, int]:  # type: ignore[override]
        """Host and port where it really listens."""
        return self.environment.communication.address

    def poll(self, timeout: float | None = 0.0) -> bool:
        """Handle what has arrived; see `Service.poll`."""
        return self.environment._process(timeout)

    def close(self) -> None:
        """End all connections and close the environment."""
        self.environment.close()


class GymnasiumScene(RLEnvironment):
    """A Gymnasium environment behind the requests of an `RLEnvironment`.

    ``action`` makes `repeat_action` steps of the environment, 1 unless configured, or fewer if the
    episode ends; their rewards are added up. The agent's data are the leaves of the observation, in
    the fields of `observation_fields`. The world's data are ``reward``, ``terminated``,
    ``truncated`` and ``info`` of the last action. ``reset`` takes an object with ``seed`` and
    ``options``. Nothing resets by itself: the last observation of an episode stays until then.
    """

    def __init__(self, worlds: Worlds) -> None:
        """Take the only world.

        Raises:
            UsageError: There are several worlds, or a space has no fixed layout.
        """
        super().__init__()
        if worlds.num_worlds != 1:
            raise UsageError(
                f'The protocol "godot-gym" serves one world, and there are {worlds.num_worlds}. '
                'The protocol "physx" serves several.'
            )
        self.worlds = worlds
        self.repeat_action = 1
        self.observation_space, self.action_space = worlds.observation_space, worlds.action_space
        self.messages = gymnasium_messages(worlds.observation_space)

    def _ready(self) -> None:
        """Put agent and world in their places."""
        space = self.worlds.observation_space
        self.agent, self.world = _GymnasiumAgent(space), _GymnasiumWorld()

    def _step(self, action: Any) -> Stepping:
        """Make `repeat_action` steps of the environment."""
        agent, outcome = self._parts()
        if not outcome.is_running:
            raise RequestError("There is no episode, or it is over: reset first.")
        taken = from_json(self.worlds.action_space, action)
        total = 0.0
        for left in reversed(range(self.repeat_action)):
            agent.observation, reward, terminated, truncated, info = self.worlds.step(0, taken)
            total += reward
            outcome.set(total, terminated, truncated, info)
            if terminated or truncated or not left:
                return
            if self.communication.is_abandoned:
                raise RequestError("The client left in the middle of a step.")
            yield 0.0

    def _reset(self) -> None:
        """Begin an episode."""
        agent, outcome = self._parts()
        value = self.reset_request if isinstance(self.reset_request, dict) else {}
        seed, options = value.get(self.SEED_KEY), value.get("options")
        if options is not None and not isinstance(options, dict):
            raise RequestError(f"Options of a reset are an object of JSON, not {options!r:.60}.")
        agent.observation, info = self.worlds.reset(0, seed, options)
        outcome.set(0.0, False, False, info)

    def close(self) -> None:
        """End all connections and close the environment."""
        super().close()
        self.worlds.close()

    def _parts(self) -> tuple[_GymnasiumAgent, _GymnasiumWorld]:
        agent, world = self._required_agent(), self._required_world()
        if not isinstance(agent, _GymnasiumAgent) or not isinstance(world, _GymnasiumWorld):
            raise UsageError("Agent and world of a Gymnasium environment are not to be replaced.")
        return agent, world


class _GymnasiumAgent(RLAgent):
    """The observation of a Gymnasium environment.

    Attributes:
        observation: The last one; None before the first reset.
    """

    def __init__(self, space: Space) -> None:
        self.observation: Any = None
        paths = [path for path, _ in leaves(space)]
        self._places = list(zip(observation_fields(space), paths, strict=True))

    def get_data(self, request: Any, storage: Any) -> None:
        """Write the observation, all of it whatever names are asked for."""
        if self.observation is None:
            raise RequestError("There is no observation yet: reset first.")
        values = {}
        for name, path in self._places:
            value = self.observation
            for key in path:
                value = value[key]
            values[name] = value
        fill(storage, **values)


class _GymnasiumWorld(RLEnvWorld):
    """What came of the last action in a Gymnasium environment.

    Attributes:
        is_running: Whether an episode has begun and is not over.
    """

    def __init__(self) -> None:
        self.is_running = False
        self._values: dict[str, Any] = {}

    def set(self, reward: float, terminated: bool, truncated: bool, info: Any) -> None:
        """Keep what came of an action."""
        self.is_running = not (terminated or truncated)
        text = json.dumps(plain(info)) if info else ""
        self._values = dict(zip(OUTCOME, (reward, terminated, truncated, text), strict=True))

    def get_data(self, request: Any, storage: Any) -> None:
        """Write what is asked for; names that are not known are ignored."""
        names = request if isinstance(request, list) and request else list(OUTCOME)
        fill(storage, **{name: value for name, value in self._values.items() if name in names})


def observation_fields(space: Space) -> list[str]:
    """Return the fields in which the leaves of an observation travel.

    A space without parts is ``observation``. A part is named by the keys that lead to it, joined by
    ``__``, where all parts have names of their own that way, and else by its number.

    Raises:
        UsageError: A part is a space whose values have no fixed shape.
    """
    paths = [path for path, _ in leaves(space)]
    if paths == [()]:
        return [OBSERVATION]
    names = ["__".join(str(key) for key in path) for path in paths]
    fit = all(n.isascii() and n.isidentifier() and n[0] != "_" for n in names)
    reserved = {"env_id", "episode", "step"} & set(names)
    if fit and not reserved and len({name.lower() for name in names}) == len(names):
        return names
    return [f"{OBSERVATION}_{number}" for number in range(len(names))]


def gymnasium_messages(space: Space) -> Messages:
    """Return the messages of a Gymnasium environment with such observations.

    Raises:
        UsageError: A part is a space whose values have no fixed shape.
    """
    parts = [leaf for _, leaf in leaves(space)]
    fields = [
        Field(name, () if isinstance(leaf, spaces.Discrete) else leaf.shape, np.dtype(leaf.dtype))
        for name, leaf in zip(observation_fields(space), parts, strict=True)
    ]
    return Messages.of_fields(agent=fields, world=list(OUTCOME.items()))
