"""Clients of godot-gym: of services of physx, and of Godot applications that use the addon."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from physx_core import Closeable, Field
from physx_core.errors import ConfigError, RemoteError, RemoteProtocolError, RequestError
from physx_remote.godot_gym.messages import DESCRIPTION, Messages, extension
from physx_remote.godot_gym.wire import OUTCOME, observation_fields
from physx_remote.serving.client_link import Link
from physx_remote.serving.framing import MAX_ANSWER
from physx_remote.serving.spaces import Space, build_space, join, leaves, to_json

Parts = dict[str, dict[str, Any] | None]
"""The parts ``agent`` and ``world`` of an answer; None for one that is not there."""


class GodotGymClient(Closeable):
    """Sends requests to a server of godot-gym and waits for the answers. A context manager.

    Attributes:
        messages: Messages of the answers; None: answers are not read.
    """

    def __init__(
        self,
        messages: Any = None,
        address: tuple[str, int] = ("127.0.0.1", 9090),
        *,
        timeout: float | None = 60.0,
        connect_timeout: float = 10.0,
        max_answer: int = MAX_ANSWER,
    ) -> None:
        """Connect.

        Args:
            messages: `Messages`, a module made by ``protoc``, or its class ``Message``; None: what
                the server describes, where it does.
            address: Host and port.
            timeout: How long an answer may take, in s; None: for ever.
            connect_timeout: How long to try to connect, in s.
            max_answer: Longest answer in bytes that is taken.

        Raises:
            ConfigError: The messages are none.
            RemoteError: Nothing answers at the address.
        """
        self.messages = None if messages is None else Messages(messages)
        self._link = Link(
            address, timeout=timeout, connect_timeout=connect_timeout, max_answer=max_answer
        )

    def request(self, request: Mapping[str, Any]) -> Parts:
        """Send a request and return its answer.

        Args:
            request: Any of the keys ``reset``, ``action``, ``config`` and ``observation``, with
                data of JSON or arrays.

        Raises:
            RequestError: The request holds what JSON has nothing for.
            RemoteError: The server reports an error, is gone, or does not answer in time.
        """
        return self.request_bytes(json.dumps(request, default=_listed).encode())

    def request_bytes(self, request: bytes) -> Parts:
        """Send a request that is JSON already; see `request`."""
        body = self._link.exchange(request)
        if self.messages is None:
            self.messages = Messages.of_fields()
        return self.messages.read(body)

    def step(self, action: Any, requested_observation: Mapping[str, Any]) -> Parts:
        """Have the agent act, and return what is asked for."""
        return self.request({"action": action, "observation": requested_observation})

    def reset(
        self,
        requested_observation: Mapping[str, Any],
        *,
        seed: int | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Parts:
        """Have the environment begin anew, and return what is asked for.

        Args:
            requested_observation: What to return.
            seed: Seed; only services of physx know it.
            options: Likewise.
        """
        value = {"seed": seed, "options": options}
        told = {name: item for name, item in value.items() if item is not None}
        return self.request({"reset": told, "observation": requested_observation})

    def configure(self, config: Mapping[str, Any]) -> None:
        """Configure any of ``agent``, ``world`` and ``environment``."""
        self.request({"config": config})

    def set_time_speed(self, speed: float | None) -> None:
        """Set how much faster than the clock time passes; None: as fast as a physx service can."""
        self.configure({"environment": {"time_speed": speed}})

    def set_repeat_action(self, frames: int) -> None:
        """Set how many physics frames an action lasts."""
        self.configure({"environment": {"repeat_action": frames}})

    def describe(self) -> dict[str, Any]:
        """Return what the server says about its messages and spaces; empty where it says nothing.

        Raises:
            RemoteProtocolError: What it says is not what physx says.
        """
        body = self._link.exchange(b'{"observation": {"environment": ["description"]}}')
        text = extension(body, DESCRIPTION)
        if text is None:
            return {}
        try:
            description = json.loads(text)
        except ValueError as error:
            raise RemoteProtocolError(f"The server's description is no JSON: {error}.") from error
        if not isinstance(description, dict) or description.get("version") != 1:
            raise RemoteProtocolError(
                f"The server's description is of another version: {text[:100]}. Install the same "
                "version of physx-core on both sides."
            )
        return description

    def close(self) -> None:
        """End the connection; calling it again does nothing."""
        self._link.close()


class GodotGymEnv(gymnasium.Env[Any, Any]):
    """An environment behind a server of godot-gym.

    Services of physx tell their messages and spaces. For another server give them, and override
    what its data mean: `observation_of`, `reward_of`, `ended_of` and `info_of`. Without that, the
    agent's fields are the observation, and the world's fields ``reward``, ``terminated`` (or
    ``done``) and ``truncated`` are what they say.

    Attributes:
        client: The connection.
        requested_observation: What each request asks for.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}  # type: ignore[misc]

    def __init__(
        self,
        address: tuple[str, int] = ("127.0.0.1", 9090),
        *,
        messages: Any = None,
        observation_space: Space | None = None,
        action_space: Space | None = None,
        requested_observation: Mapping[str, Any] | None = None,
        repeat_action: int | None = None,
        time_speed: float | None = None,
        timeout: float | None = 60.0,
        connect_timeout: float = 10.0,
        max_answer: int = MAX_ANSWER,
    ) -> None:
        """Connect, and ask for what is not given.

        Args:
            address: Host and port.
            messages: See `GodotGymClient`.
            observation_space: Space of the observations; None: as the server says, or arrays
                without bounds in the shapes of the agent's fields.
            action_space: Space of the actions; None: as the server says.
            requested_observation: Object with any of ``agent`` and ``world``; None: all fields of
                both by name.
            repeat_action: How many physics frames an action lasts; None: as it is.
            time_speed: How much faster than the clock time passes; None: as it is.
            timeout: How long an answer may take, in s; None: for ever.
            connect_timeout: How long to try to connect, in s.
            max_answer: Longest answer in bytes that is taken.

        Raises:
            ConfigError: An argument cannot be what it is for.
            RemoteError: Nothing answers, or the server does not say what was not given.
        """
        _check_given(observation_space, action_space, requested_observation)
        self.client = GodotGymClient(
            messages, address, timeout=timeout, connect_timeout=connect_timeout,
            max_answer=max_answer,
        )  # fmt: skip
        try:
            told = self._told(messages, observation_space, action_space)
            self._messages = self.client.messages or Messages.from_dict(told["messages"])
            self.client.messages = self._messages
            self.observation_space = observation_space or self._space("observation", told)
            self.action_space = action_space or self._space("action", told)
            self.requested_observation = requested_observation or self._all_fields()
            values = {"repeat_action": repeat_action, "time_speed": time_speed}
            given = {name: value for name, value in values.items() if value is not None}
            if given:
                self.client.configure({"environment": given})
        except BaseException:
            self.client.close()
            raise
        self._names = observation_fields(self.observation_space)
        self._leaves = [leaf for _, leaf in leaves(self.observation_space)]
        wanted = json.dumps(self.requested_observation)
        self._rest = f', "observation": {wanted}}}'.encode()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; a service of physx takes the seed and the options.

        Raises:
            RemoteError: The server reports an error, is gone, or does not answer in time.
        """
        super().reset(seed=seed)
        data = self.client.reset(self.requested_observation, seed=seed, options=options)
        return self.observation_of(data), self.info_of(data)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act.

        Raises:
            RemoteError: The server reports an error, is gone, or does not answer in time.
        """
        acted = json.dumps(to_json(self.action_space, action)).encode()
        data = self.client.request_bytes(b'{"action": ' + acted + self._rest)
        terminated, truncated = self.ended_of(data)
        reward, info = self.reward_of(data), self.info_of(data)
        return self.observation_of(data), reward, terminated, truncated, info

    def close(self) -> None:
        """End the connection; calling it again does nothing."""
        self.client.close()

    # What data mean -------------------------------------------------------------------------

    def observation_of(self, data: Parts) -> Any:
        """Return the observation in an answer.

        Raises:
            RemoteProtocolError: A field of the observation is not in the answer.
        """
        agent = data["agent"] or {}
        try:
            values = [agent[name] for name in self._names]
        except KeyError as error:
            raise RemoteProtocolError(
                f"The answer lacks the field {error} of the observation; it has {list(agent)}. "
                "Override observation_of, or give requested_observation."
            ) from None
        fitting = (_fitted(leaf, v) for leaf, v in zip(self._leaves, values, strict=True))
        return join(self.observation_space, fitting)

    def reward_of(self, data: Parts) -> float:
        """Return the reward in an answer."""
        return float((data["world"] or {}).get("reward", 0.0))

    def ended_of(self, data: Parts) -> tuple[bool, bool]:
        """Return whether the episode is terminated, and whether it is truncated."""
        world = data["world"] or {}
        ended = world.get("terminated", world.get("done", False))
        return bool(ended), bool(world.get("truncated", False))

    def info_of(self, data: Parts) -> dict[str, Any]:
        """Return what else is in an answer: ``info``, and the world's other fields by name."""
        world = data["world"] or {}
        others = {n: v for n, v in world.items() if n not in OUTCOME and n != "done"}
        text = world.get("info")
        return {**others, **json.loads(text)} if text else others

    # ----------------------------------------------------------------------------------------

    def _told(self, messages: Any, observation: Any, action: Any) -> dict[str, Any]:
        """Return what the server says, if there is anything to ask."""
        if messages is not None and observation is not None and action is not None:
            return {}
        told = self.client.describe()
        if messages is None and not (told.get("messages") or {}).get("agent"):
            raise RemoteError(
                "The server does not say what its messages are. Give messages=: the module that "
                "protoc made for its application, or Messages.of_fields(agent=..., world=...)."
            )
        return told

    def _space(self, kind: str, told: Mapping[str, Any]) -> Space:
        """Return a space that was not given."""
        plain = told.get("spaces", {}).get(kind)
        if plain is not None:
            return build_space(plain)
        declared = self._messages.agent if kind == "observation" else {}
        fields = {name: field for name, field in declared.items() if isinstance(field, Field)}
        if not fields or any(field.shape is None for field in fields.values()):
            raise RemoteError(
                f"The server does not say what its {kind}s are: give {kind}_space=, a space of "
                "Gymnasium."
            )
        parts = {name: _unbounded(field) for name, field in fields.items()}
        return parts["observation"] if [*parts] == ["observation"] else spaces.Dict(parts)

    def _all_fields(self) -> dict[str, list[str]]:
        fields = self._messages.Message.DESCRIPTOR.fields_by_name
        parts = {"agent": "agent_data", "world": "world_data"}
        return {
            key: [field.name for field in fields[name].message_type.fields]
            for key, name in parts.items()
        }


def _listed(value: Any) -> Any:
    """Return an array or number of numpy as JSON has it."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise RequestError(f"A request is data of JSON or arrays, and {value!r:.80} is neither.")


def _unbounded(field: Field) -> Space:
    dtype = np.dtype(field.dtype)
    if dtype.kind == "f":
        return spaces.Box(-np.inf, np.inf, field.shape, dtype.type)
    low, high = (0, 1) if dtype.kind == "b" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    return spaces.Box(low, high, field.shape, np.int8 if dtype.kind == "b" else dtype.type)


def _fitted(leaf: Space, value: Any) -> Any:
    """Return a value in the type and shape of its space."""
    if isinstance(leaf, spaces.Discrete):
        return leaf.dtype.type(value)
    source = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value
    array = np.asarray(source, leaf.dtype)
    try:
        return array if array.shape == leaf.shape else array.reshape(leaf.shape)
    except ValueError:
        raise RemoteProtocolError(
            f"A part of the observation has {array.size} values, and {leaf} has the shape "
            f"{leaf.shape}."
        ) from None


def _check_given(observation_space: Any, action_space: Any, requested: Any) -> None:
    """Check the spaces and the request; each may be None.

    Raises:
        ConfigError: One is not what it is for.
    """
    for option, space in (("observation", observation_space), ("action", action_space)):
        if space is not None and not isinstance(space, gymnasium.Space):
            raise ConfigError(f"{option}_space is {space!r:.80}, which is no gymnasium.Space.")
    if not isinstance(requested, Mapping | None):
        raise ConfigError(
            f"requested_observation is {requested!r:.80} but must be a dictionary "
            'such as {"agent": ["position"], "world": []}.'
        )
