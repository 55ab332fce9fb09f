"""PhysxClient, which drives the worlds of a service; PhysxEnv, one of them as a gymnasium.Env."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Unpack

import gymnasium
import numpy as np

from physx_core import Closeable
from physx_core.errors import ConfigError
from physx_core.net import Kind, pack_value
from physx_core.typing import Array
from physx_remote.errors import RemoteProtocolError
from physx_remote.physx.link import PhysxLink
from physx_remote.physx.space_arrays import SpaceArrays, is_array
from physx_remote.physx.wire import (
    ACT,
    REWARD,
    TERMINATED,
    TRUNCATED,
    WORLDS,
    split_infos,
)
from physx_remote.serving.connect_options import TokenOptions
from physx_remote.serving.spaces import MALFORMED_INPUT_ERRORS, build_space, check_shape

LOG = logging.getLogger("physx.remote")

_INVALID: tuple[type[Exception], ...] = (RemoteProtocolError, *MALFORMED_INPUT_ERRORS)
_FLOAT, _BOOL = np.dtype(np.float64), np.dtype(np.bool_)


class Outcomes(NamedTuple):
    """Results of a request in some of the worlds; the caller owns the arrays.

    Attributes:
        arrays: The arrays by their names in the protocol, each with a leading axis of worlds.
        infos: Info of each world.
    """

    arrays: dict[str, Array]
    infos: Sequence[dict[str, Any]]


class PhysxClient(Closeable):
    """Drives the worlds of a service, any number of them per request. A context manager.

    Attributes:
        name: Name of the environments.
        num_worlds: Number of worlds.
        has_snapshots: Whether the state of a world can be saved and restored.
        render_mode: How the worlds are rendered; None: not at all.
        metadata: Metadata of the Gymnasium environment.
        observations: Space of one world's observations, as arrays.
        actions: Space of one world's actions, as arrays.
    """

    def __init__(self, address: tuple[str, int], **options: Unpack[TokenOptions]) -> None:
        """Connect.

        Args:
            address: Host and port.
            options: See `TokenOptions`.

        Raises:
            ConfigError: If there is no token.
            RemoteError: If nothing answers, another client is already acting, or the tokens differ.
        """
        self._link = PhysxLink(address, ACT, **options)
        told = read_introduction(self._link)
        self.observations, self.actions = told.observations, told.actions
        self.name, self.num_worlds = told.name, told.num_worlds
        self.has_snapshots, self.render_mode = told.has_snapshots, told.render_mode
        self.metadata = told.metadata
        self._names = {REWARD, *self.observations.names, TERMINATED, TRUNCATED}
        self._number = 0
        self._left_out: set[str] = set()

    @property
    def timeout(self) -> float | None:
        """Time limit for answers from now on in s; None: no limit."""
        return self._link.timeout

    @timeout.setter
    def timeout(self, seconds: float | None) -> None:
        self._link.timeout = seconds

    # Worlds ---------------------------------------------------------------------------------

    def reset(
        self,
        worlds: Sequence[int] | None = None,
        *,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Outcomes:
        """Start new episodes.

        Args:
            worlds: Numbers of the worlds; None: all.
            seeds: A seed for each of them; None: unseeded.
            options: Options of each reset, plain values.

        Raises:
            PhysxError: If a world raises, or the service disconnects or does not answer in time.
        """
        self.ask_reset(worlds, seeds, options)
        return self.outcomes(len(worlds) if worlds is not None else self.num_worlds)

    def step(self, actions: dict[str, Array], worlds: Sequence[int] | None = None) -> Outcomes:
        """Step worlds in order. If one raises, the worlds after it are not stepped.

        Args:
            actions: Arrays returned by ``client.actions.stack(...)``.
            worlds: Numbers of the worlds; None: all.

        Raises:
            PhysxError: If a world raises, or the service disconnects or does not answer in time.
        """
        self.ask_step(actions, None if worlds is None else np.array(worlds, np.int64))
        return self.outcomes(len(worlds) if worlds is not None else self.num_worlds)

    def snapshot(self, world: int = 0) -> int:
        """Save a world's state in the service and return the number of the snapshot.

        It is kept until it is deleted with `forget`, or this client leaves.

        Raises:
            PhysxError: If the environment has no snapshots, or there are already too many.
        """
        number = self.ask({"do": "snapshot", "world": world})
        if type(number) is not int:
            raise self._link.protocol_error("a snapshot without a number")
        return number

    def restore(self, snapshot: int, world: int = 0) -> Outcomes:
        """Restore a snapshot, taken in any world, in a world.

        Returns:
            The last result at the time of the snapshot.

        Raises:
            PhysxError: If the snapshot does not exist.
        """
        self._request({"do": "restore", "world": world, "snapshot": snapshot})
        return self.outcomes(1)

    def forget(self, snapshot: int) -> bool:
        """Delete a snapshot; return whether it existed."""
        return bool(self.ask({"do": "forget", "snapshot": snapshot}))

    def render(self, world: int = 0) -> Any:
        """Return the rendering of a world.

        Raises:
            PhysxError: If rendering raises, or its result cannot be sent.
        """
        return self.ask({"do": "render", "world": world})

    def close(self) -> None:
        """Close the connection; calling it again does nothing."""
        self._link.close()

    # Requests and answers separately, for several concurrent requests ------------------------

    def ask_reset(
        self,
        worlds: Sequence[int] | None,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Send the request of `reset`; `outcomes` returns the answer."""
        request: dict[str, Any] = {"do": "reset"}
        if worlds is not None:
            request["worlds"] = [int(world) for world in worlds]
        if seeds is not None:
            request["seeds"] = [None if seed is None else int(seed) for seed in seeds]
        if options is not None:
            request["options"] = dict(options)
        self._request(request)

    def ask_step(self, actions: dict[str, Array], worlds: Array | None) -> None:
        """Send the request of `step`; `outcomes` returns the answer."""
        if worlds is not None:
            actions = {WORLDS: worlds, **actions}
        self._number += 1
        self._link.send(pack_value(Kind.ACTIONS, actions, "actions", self._number))

    def outcomes(self, count: int, back: int = 0) -> Outcomes:
        """Return the answer to a request.

        Args:
            count: Number of worlds in the request.
            back: Number of requests sent after it.

        Raises:
            PhysxError: If the request failed.
        """
        notes, arrays = self._answer(self._number - back)
        if not isinstance(arrays, dict) or arrays.keys() != self._names:
            raise self._link.protocol_error("an answer without the arrays of worlds")
        if not (fit_outcome(arrays, count) and self.observations.fit(arrays, count)):
            raise self._link.protocol_error("an answer that does not fit the worlds' spaces")
        if notes is None:
            return Outcomes(arrays, [{} for _ in range(count)])
        infos, left_out = split_infos(notes, count)
        new = set(left_out) - self._left_out
        if new:
            self._left_out |= new
            LOG.warning(
                "Infos with these names are omitted because they contain more than plain values "
                "and arrays: %s.",
                ", ".join(sorted(new)),
            )
        return Outcomes(arrays, infos)

    def ask(self, request: dict[str, Any]) -> Any:
        """Send a request and return its answer, a plain value."""
        self._request(request)
        return self._answer(self._number)[1]

    def _request(self, request: dict[str, Any]) -> None:
        self._number += 1
        self._link.send(pack_value(Kind.REQUEST, request, "request", self._number))

    def _answer(self, number: int) -> tuple[Any, Any]:
        """Return the notes sent with an answer, None if there are none, and the answer."""
        notes = None
        while True:
            frame = self._link.receive()
            if frame.number != number:
                raise self._link.protocol_error(
                    f"an answer to request {frame.number} instead of {number}"
                )
            if frame.kind in (Kind.ANSWER, Kind.REFUSAL):
                return notes, self._link.decode(frame)
            if frame.kind is not Kind.NOTES:
                raise self._link.protocol_error(f"a message {frame.kind.name}")
            notes = self._link.decode(frame)


class PhysxEnv(gymnasium.Env[Any, Any]):
    """One world of a service. Closing it closes the connection.

    Attributes:
        client: The connection, which other worlds may share.
        world: Number of the world.
    """

    def __init__(self, client: PhysxClient, world: int = 0) -> None:
        """Use a world.

        Args:
            client: The connection.
            world: Number of the world.

        Raises:
            ConfigError: If the world does not exist.
        """
        if not 0 <= world < client.num_worlds:
            raise ConfigError(f"There is no world {world}: there are 0 to {client.num_worlds - 1}.")
        self.client, self.world = client, world
        self.observation_space = client.observations.space
        self.action_space = client.actions.space
        self.render_mode = client.render_mode
        self.metadata = client.metadata
        self._worlds = [world]
        self._number = None if client.num_worlds == 1 else np.array([world], np.int64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the world.
            options: Options of the environment, plain values.

        Raises:
            PhysxError: If the world raises, or the service disconnects or does not answer in time.
        """
        super().reset(seed=seed)
        outcomes = self.client.reset(self._worlds, seeds=[seed], options=options)
        return self.client.observations.row(outcomes.arrays, 0), outcomes.infos[0]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step the world.

        Raises:
            ActionError: If the action does not have the structure, shapes or types of the space.
            PhysxError: If the world raises, or the service disconnects or does not answer in time.
        """
        client = self.client
        client.ask_step(client.actions.stack(action, one=True), self._number)
        arrays, infos = client.outcomes(1)
        return (
            client.observations.row(arrays, 0),
            float(arrays[REWARD][0]),
            bool(arrays[TERMINATED][0]),
            bool(arrays[TRUNCATED][0]),
            infos[0],
        )

    def render(self) -> Any:
        """Return the rendering of the world."""
        return self.client.render(self.world)

    def snapshot(self) -> int:
        """Save the world's state: see `PhysxClient.snapshot`."""
        return self.client.snapshot(self.world)

    def restore(self, state: int) -> Any:
        """Restore a snapshot; return its observation."""
        outcomes = self.client.restore(state, self.world)
        return self.client.observations.row(outcomes.arrays, 0)

    def close(self) -> None:
        """Close the connection; calling it again does nothing."""
        self.client.close()


class Introduction(NamedTuple):
    """A service's description of itself.

    Attributes:
        observations: Space of one world's observations, as arrays.
        actions: Space of one world's actions, as arrays.
        name: Name of the environments.
        num_worlds: Number of worlds.
        has_snapshots: Whether the state of a world can be saved and restored.
        render_mode: How the worlds are rendered; None: not at all.
        metadata: Metadata of the Gymnasium environment.
    """

    observations: SpaceArrays
    actions: SpaceArrays
    name: str
    num_worlds: int
    has_snapshots: bool
    render_mode: str | None
    metadata: dict[str, Any]


def read_introduction(link: PhysxLink) -> Introduction:
    """Return the validated description of the service at the other end of a connection.

    Raises:
        RemoteProtocolError: If it is invalid; the connection is then closed.
    """
    told = link.introduction
    try:
        observations = SpaceArrays(build_space(told["observation_space"]), "observation")
        actions = SpaceArrays(build_space(told["action_space"]), "action")
        count, metadata = told["num_worlds"], {"render_modes": list(told["render_modes"])}
        if type(count) is not int or count < 1:
            raise ValueError(f"{count!r:.40} worlds")
        for leaf in (*observations.leaves, *actions.leaves):
            check_shape(leaf.shape or (), count)
        if told["render_fps"] is not None:
            metadata["render_fps"] = told["render_fps"]
        return Introduction(
            observations,
            actions,
            str(told["name"]),
            count,
            bool(told["snapshot"]),
            told["render_mode"],
            metadata,
        )
    except _INVALID as error:
        raise link.protocol_error(f"an invalid introduction: {error}") from error
    except BaseException:
        link.close()
        raise


def fit_outcome(arrays: Mapping[str, Any], count: int) -> bool:
    """Return whether received rewards and flags are valid for `count` worlds."""
    return is_array(arrays[REWARD], _FLOAT, (count,)) and all(
        is_array(arrays[name], _BOOL, (count,)) for name in (TERMINATED, TRUNCATED)
    )
