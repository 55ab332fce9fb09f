"""Clients of godot-rl: the trainer's side, for applications with its plugin and for physx."""

from __future__ import annotations

import json
import reprlib
import socket
from collections.abc import Mapping
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from physx_core import Closeable
from physx_core.errors import UsageError
from physx_core.typing import Array
from physx_remote.errors import RemoteError, RemoteProtocolError, RemoteTimeoutError
from physx_remote.godot_rl.json_spaces import (
    ACTION,
    OBSERVATION,
    action_space_of,
    observation_space_of,
    read_observation,
)
from physx_remote.serving.client_link import RequestLink
from physx_remote.serving.connect_options import ConnectOptions
from physx_remote.serving.spaces import MALFORMED_INPUT_ERRORS, Space, check_shape

VERSION = {"major_version": "0", "minor_version": "7"}
"""Version of the protocol sent in the handshake."""


class _Incoming(RequestLink):
    """The connection of an application, which connects to this side."""

    def _connected(self, address: tuple[str, int], patience: float) -> socket.socket:
        try:
            listener = socket.create_server(address)
        except (OSError, OverflowError) as error:
            raise RemoteError(
                f"Cannot listen at {self.name}: {error}. Another program, such as a running "
                "trainer, may be using the port."
            ) from error
        with listener:
            listener.settimeout(patience)
            try:
                return listener.accept()[0]
            except TimeoutError as error:
                raise RemoteTimeoutError(
                    f"No application connected to {self.name} within {patience:g} s. Start it with "
                    "this port, or set a longer connect_timeout."
                ) from error


class GodotRLVectorEnv(VectorEnv[Any, Any, Any], Closeable):
    """The agents of an application that connects to an address: the trainer's side of godot-rl.

    Observations and actions are dictionaries with the application's keys; a single key ``obs`` or
    ``action`` is dropped. An agent whose episode ends starts the next one automatically. If the
    application sends both, as physx services do, terminated and truncated are distinguished and
    ``final_obs`` is in the infos; otherwise, an episode that is done counts as terminated.
    """

    def __init__(
        self,
        address: tuple[str, int] = ("127.0.0.1", 11008),
        **options: Unpack[ConnectOptions],
    ) -> None:
        """Wait for the application and request its spaces.

        Args:
            address: Host and port where the application is expected.
            options: See `ConnectOptions`; the default of ``connect_timeout`` is 60 s.

        Raises:
            RemoteError: If the port is in use, no application connects, or its agents differ.
        """
        options.setdefault("connect_timeout", 60.0)
        self._link = _Incoming(address, **options)
        try:
            self._link.tell(json.dumps({"type": "handshake", **VERSION}).encode())
            told = self._ask({"type": "env_info"}, "env_info")
            self.num_envs = _count(told)
            self._observed = _spaces(told, "observation_space", self.num_envs, observation_space_of)
            self._acted = _spaces(told, "action_space", self.num_envs, action_space_of)
        except BaseException:
            self._link.close()
            raise
        self.agent_policy_names = told.get("agent_policy_names", [""] * self.num_envs)
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.single_observation_space = _whole(self._observed, OBSERVATION)
        self.single_action_space = _whole(self._acted, ACTION)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start new episodes in all worlds.

        Args:
            seed: Seed of the application; only physx services use it.
            options: Must be empty.

        Raises:
            UsageError: If there are options, or the seed is not an integer.
            RemoteError: If the application reports an error, disconnects, or does not answer in
                time.
        """
        if options:
            raise UsageError(f"godot-rl takes no reset options: {list(options)}.")
        if seed is not None and not isinstance(seed, (int, np.integer)):
            raise UsageError(f"The seed must be one integer for all agents, not {seed!r}.")
        super().reset(seed=None if seed is None else int(seed))
        observations, each = self.reset_each(None if seed is None else int(seed))
        return self._batch(observations), self._merge(each)

    def reset_each(self, seed: int | None) -> tuple[list[Any], list[dict[str, Any]]]:
        """Start new episodes in all worlds; return each agent's observation and info."""
        told = self._ask({"type": "reset"} | ({} if seed is None else {"seed": seed}), "reset")
        seen = _each(told, "obs", self.num_envs)
        return [self._observation(one) for one in seen], self._infos(told)

    def step(self, actions: Any) -> tuple[Any, Array, Array, Array, dict[str, Any]]:
        """Step all agents.

        Raises:
            RemoteError: If the application reports an error, disconnects, or does not answer in
                time.
        """
        by_name = isinstance(self.single_action_space, spaces.Dict)
        entries = actions if by_name else {ACTION: actions}
        columns = self.plain_actions(entries)
        acted = [{n: column[i] for n, column in columns.items()} for i in range(self.num_envs)]
        observations, rewards, terminated, truncated, each = self.step_each(acted)
        return self._batch(observations), rewards, terminated, truncated, self._merge(each)

    def plain_actions(self, entries: Mapping[str, Any]) -> dict[str, Any]:
        """Return actions with the application's keys as numbers and lists of numbers."""
        parts = self._acted.items()
        return {n: np.asarray(entries[n], space.dtype).tolist() for n, space in parts}

    def step_each(
        self, acted: list[dict[str, Any]]
    ) -> tuple[list[Any], Array, Array, Array, list[dict[str, Any]]]:
        """Step all agents.

        Args:
            acted: Each agent's action with the application's keys, as numbers and lists of numbers.

        Returns:
            Each agent's observation, reward, terminated, truncated and info.
        """
        told = self._ask({"type": "action", "action": acted}, "step")
        observations = [self._observation(one) for one in _each(told, "obs", self.num_envs)]
        rewards = self._rewards(_each(told, "reward", self.num_envs, (int, float)))
        done = np.array(_each(told, "done", self.num_envs, (bool, int, float)), bool)
        infos = self._infos(told)
        for info in infos:
            if "terminal_observation" in info:
                info["final_obs"] = self._observation(info.pop("terminal_observation"))
        cut = [bool(i.get("truncated")) and not i.get("terminated") for i in infos]
        truncated = done & np.array(cut)
        return observations, rewards, done & ~truncated, truncated, infos

    def _rewards(self, told: list[Any]) -> Array:
        try:
            return np.array(told, np.float64)
        except OverflowError as error:
            raise RemoteProtocolError(f"The application sent an invalid reward: {error}.") from None

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method without arguments for all agents, and return their results.

        Raises:
            UsageError: If there are arguments.
            RemoteError: If the application reports an error, disconnects, or does not answer in
                time.
        """
        if args or kwargs:
            raise UsageError("godot-rl can only call methods without arguments.")
        told = self._ask({"type": "call", "method": name}, "call")
        return tuple(_each(told, "returns", self.num_envs, object))

    def close_extras(self, **kwargs: Any) -> None:
        """Close the application and the connection."""
        try:
            self._link.tell(b'{"type": "close"}')
        except RemoteError:
            pass  # already gone
        finally:
            self._link.close()

    # ----------------------------------------------------------------------------------------

    def _ask(self, message: Mapping[str, Any], kind: str) -> dict[str, Any]:
        body = self._link.exchange(json.dumps(message).encode())
        try:
            told = json.loads(body)
        except (ValueError, RecursionError) as error:
            raise RemoteProtocolError(
                f"{self._link.name} did not answer with JSON: {error}."
            ) from error
        if isinstance(told, dict) and told.get("type") == kind:
            return told
        if isinstance(told, dict) and told.get("type") == "error":
            said = [told.get(key) for key in ("error", "message")]
            texts = (one if isinstance(one, str) else reprlib.repr(one) for one in said)
            raise RemoteError(": ".join([self._link.name, *texts]))
        raise RemoteProtocolError(f"{self._link.name} answered {body[:100]!r} instead of a {kind}.")

    def _infos(self, told: Mapping[str, Any]) -> list[dict[str, Any]]:
        """Return each agent's info; older applications do not send any."""
        if "info" not in told:
            return [{} for _ in range(self.num_envs)]
        return [dict(info) for info in _each(told, "info", self.num_envs)]

    def _merge(self, each: list[dict[str, Any]]) -> dict[str, Any]:
        infos: dict[str, Any] = {}
        try:
            for agent, info in enumerate(each):
                infos = self._add_info(infos, info, agent)
        except MALFORMED_INPUT_ERRORS as error:
            raise RemoteProtocolError(
                f"The infos of the agents are incompatible: {error}."
            ) from error
        return infos

    def _batch(self, observations: list[Any]) -> Any:
        space = self.single_observation_space
        batch: Any = create_empty_array(space, self.num_envs)
        return concatenate(space, observations, batch)

    def _observation(self, told: Any) -> Any:
        """Return one agent's observation."""
        try:
            values = {n: read_observation(n, part, told[n]) for n, part in self._observed.items()}
        except MALFORMED_INPUT_ERRORS as error:
            raise RemoteProtocolError(
                f"The application sent the observation {reprlib.repr(told)}, which does not fit "
                f"its description {self._observed}: {error!r}."
            ) from error
        is_dict = isinstance(self.single_observation_space, spaces.Dict)
        return values if is_dict else values[OBSERVATION]


class GodotRLEnv(gymnasium.Env[Any, Any]):
    """The only agent of an application that connects to an address: see `GodotRLVectorEnv`.

    Attributes:
        agents: The vector environment that contains it.
    """

    def __init__(
        self,
        address: tuple[str, int] = ("127.0.0.1", 11008),
        **options: Unpack[ConnectOptions],
    ) -> None:
        """Wait for the application.

        Args:
            address: Host and port where the application is expected.
            options: Options of `GodotRLVectorEnv`.

        Raises:
            RemoteError: As for `GodotRLVectorEnv`, or if the application has several agents.
        """
        self.agents = GodotRLVectorEnv(address, **options)
        if self.agents.num_envs != 1:
            self.agents.close()
            raise RemoteError(
                f"The application has {self.agents.num_envs} agents: use connect_vector()."
            )
        self.observation_space = self.agents.single_observation_space
        self.action_space = self.agents.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode: see `GodotRLVectorEnv.reset`.

        Raises:
            UsageError: If there are options.
            RemoteError: If the application reports an error, disconnects, or does not answer in
                time.
        """
        super().reset(seed=seed)
        if options:
            raise UsageError(f"godot-rl takes no reset options: {list(options)}.")
        observations, infos = self.agents.reset_each(seed)
        return observations[0], infos[0]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the agent; at the end of an episode, the observation is its last one."""
        entries = action if isinstance(self.action_space, spaces.Dict) else {ACTION: action}
        told = self.agents.step_each([self.agents.plain_actions(entries)])
        observations, rewards, terminated, truncated, infos = told
        seen = infos[0].pop("final_obs", observations[0])
        return seen, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), infos[0]

    def close(self) -> None:
        """Close the application and the connection."""
        self.agents.close()


def _each(told: Mapping[str, Any], key: str, count: int, kind: Any = dict) -> list[Any]:
    """Return an answer's values for all agents, after checking their type."""
    values = told.get(key)
    is_list = isinstance(values, list) and len(values) == count
    if not is_list or not all(isinstance(value, kind) for value in values or ()):
        raise RemoteProtocolError(
            f'The application sent {reprlib.repr(values)} as "{key}" instead of a list of {count}.'
        )
    return list(values or ())


def _count(told: Mapping[str, Any]) -> int:
    count: Any = told.get("n_agents")
    if type(count) in (int, float) and 1 <= count < 1 << 20:  # Godot sends integers as 2.0
        return int(count)
    raise RemoteProtocolError(f"The application reported {reprlib.repr(count)} agents.")


def _spaces(told: Mapping[str, Any], key: str, count: int, make: Any) -> dict[str, Space]:
    """Return the spaces of an agent's entries, which must be the same for all agents."""
    given: Any = told.get(key)
    each = given if isinstance(given, list) else [given] * count
    try:
        if len(each) != count or any(one != each[0] for one in each):
            raise RemoteError(
                f"The application's agents do not all have the same {key}, so they cannot be "
                f"driven together: {reprlib.repr(given)}"
            )
        parts = {name: make(name, entry) for name, entry in each[0].items()}
        for space in parts.values():
            check_shape(space.shape or (), count)
    except MALFORMED_INPUT_ERRORS as error:
        raise RemoteProtocolError(
            f"The {key} {reprlib.repr(each)} is invalid: {error!r}."
        ) from error
    return parts


def _whole(parts: dict[str, Space], alone: str) -> Space:
    return parts[alone] if parts.keys() == {alone} else spaces.Dict(parts)
