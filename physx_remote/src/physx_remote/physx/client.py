"""Clients of the protocol physx: all that a service offers, and one of its worlds as a gym.Env."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from physx_core import Closeable, PhysxError
from physx_core.errors import ConfigError, RemoteProtocolError
from physx_core.net import Kind, pack_value
from physx_core.typing import Array
from physx_remote.physx.link import PhysxLink
from physx_remote.physx.wire import (
    ACT,
    REWARD,
    TERMINATED,
    TRUNCATED,
    WORLDS,
    Leaves,
    infos_of,
)
from physx_remote.serving.framing import MAX_ANSWER
from physx_remote.serving.spaces import build_space

LOG = logging.getLogger("physx.remote")


class Rows(NamedTuple):
    """What became of some worlds; the arrays have a leading axis of them and are the caller's own.

    Attributes:
        arrays: All arrays by their names on the wire.
        infos: Info of each world.
    """

    arrays: dict[str, Array]
    infos: Sequence[dict[str, Any]]


class PhysxClient(Closeable):
    """Drives the worlds of a service, any of them with one request. A context manager.

    Attributes:
        name: What is served.
        num_worlds: How many worlds there are.
        has_snapshots: Whether worlds can be put back to where they were.
        render_mode: How the worlds are rendered, None for not at all.
        metadata: What Gymnasium's environments say about themselves.
        observations: Space of one world's observations, and its arrays.
        actions: Space of one world's actions, and its arrays.
    """

    def __init__(
        self,
        address: tuple[str, int],
        *,
        token: str | None = None,
        token_file: str | None = None,
        timeout: float | None = 60.0,
        connect_timeout: float = 10.0,
        max_answer: int = MAX_ANSWER,
    ) -> None:
        """Connect; the arguments are those of `PhysxLink`.

        Raises:
            ConfigError: There is no token.
            RemoteError: Nothing answers, another client acts already, or the tokens differ.
        """
        self._link = PhysxLink(
            address,
            ACT,
            token=token,
            token_file=token_file,
            timeout=timeout,
            connect_timeout=connect_timeout,
            max_answer=max_answer,
        )
        try:
            told = self._link.introduction
            self.observations, self.actions = introduced_leaves(told)
            self.name = str(told["name"])
            self.num_worlds = int(told["num_worlds"])
            self.has_snapshots = bool(told["snapshot"])
            self.render_mode: str | None = told["render_mode"]
            self.metadata = {"render_modes": list(told["render_modes"])}
            if told["render_fps"] is not None:
                self.metadata["render_fps"] = told["render_fps"]
        except BaseException:
            self._link.close()
            raise
        self._names = {REWARD, *self.observations.names, TERMINATED, TRUNCATED}
        self._number = 0
        self._left_out: set[str] = set()

    @property
    def timeout(self) -> float | None:
        """How long an answer may take from now on, in s; None: for ever."""
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
    ) -> Rows:
        """Begin new episodes.

        Args:
            worlds: Numbers of the worlds; None: all.
            seeds: A seed for each of them; None: none.
            options: Options of each reset, plain values.

        Raises:
            PhysxError: A world raised, or the service is gone or too late.
        """
        self.ask_reset(worlds, seeds, options)
        return self.rows(len(worlds) if worlds is not None else self.num_worlds)

    def step(self, actions: dict[str, Array], worlds: Sequence[int] | None = None) -> Rows:
        """Step worlds. If one raises, those before it are stepped and those after it are not.

        Args:
            actions: Arrays as ``client.actions.stacked(...)`` makes them.
            worlds: Numbers of the worlds; None: all.

        Raises:
            PhysxError: A world raised, or the service is gone or too late.
        """
        self.ask_step(actions, None if worlds is None else np.array(worlds, np.int64))
        return self.rows(len(worlds) if worlds is not None else self.num_worlds)

    def snapshot(self, world: int = 0) -> int:
        """Keep a world's state at the service; return the snapshot's number.

        It is kept until it is forgotten or this client leaves.

        Raises:
            PhysxError: The environment has no snapshots, or too many are kept.
        """
        return int(self.ask({"do": "snapshot", "world": world}))

    def restore(self, snapshot: int, world: int = 0) -> Rows:
        """Put a world into the state of a snapshot, of itself or of another world.

        Returns:
            What the world answered last when the snapshot was taken.

        Raises:
            PhysxError: There is no such snapshot.
        """
        self._request({"do": "restore", "world": world, "snapshot": snapshot})
        return self.rows(1)

    def forget(self, snapshot: int) -> bool:
        """Forget a snapshot; return whether there was one of this number."""
        return bool(self.ask({"do": "forget", "snapshot": snapshot}))

    def render(self, world: int = 0) -> Any:
        """Return what a world renders.

        Raises:
            PhysxError: It raised, or renders what cannot travel.
        """
        return self.ask({"do": "render", "world": world})

    def close(self) -> None:
        """End the connection; calling it again does nothing."""
        self._link.close()

    # Requests and their answers apart, for several at a time ---------------------------------

    def ask_reset(
        self,
        worlds: Sequence[int] | None,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        """Send what `reset` sends; `rows` returns the answer."""
        request: dict[str, Any] = {"do": "reset"}
        if worlds is not None:
            request["worlds"] = [int(world) for world in worlds]
        if seeds is not None:
            request["seeds"] = [None if seed is None else int(seed) for seed in seeds]
        if options is not None:
            request["options"] = dict(options)
        self._request(request)

    def ask_step(self, actions: dict[str, Array], worlds: Array | None) -> None:
        """Send what `step` sends; `rows` returns the answer."""
        if worlds is not None:
            actions = {WORLDS: worlds, **actions}
        self._number += 1
        self._link.send(pack_value(Kind.ACTIONS, actions, "actions", self._number))

    def rows(self, count: int, back: int = 0) -> Rows:
        """Return the answer to a request that was sent.

        Args:
            count: Of how many worlds.
            back: How many requests were sent after it.

        Raises:
            PhysxError: The request failed.
        """
        notes, arrays = self._answer(self._number - back)
        if not isinstance(arrays, dict) or arrays.keys() != self._names:
            raise self._nonsense("an answer that is not about worlds")
        if any(np.shape(array)[:1] != (count,) for array in arrays.values()):
            raise self._nonsense("an answer that is not about the worlds that were asked for")
        if notes is None:
            return Rows(arrays, [{} for _ in range(count)])
        infos, left_out = infos_of(notes, count)
        new = set(left_out) - self._left_out
        if new:
            self._left_out |= new
            LOG.warning(
                "Infos of these names are left out, for they hold more than plain values and "
                "arrays: %s.",
                ", ".join(sorted(new)),
            )
        return Rows(arrays, infos)

    def ask(self, request: dict[str, Any]) -> Any:
        """Send a request that is answered with a plain value, and return it."""
        self._request(request)
        return self._answer(self._number)[1]

    def _request(self, request: dict[str, Any]) -> None:
        self._number += 1
        self._link.send(pack_value(Kind.REQUEST, request, "request", self._number))

    def _answer(self, number: int) -> tuple[Any, Any]:
        """Return what came with an answer, None for nothing, and the answer."""
        notes = None
        while True:
            frame = self._link.receive()
            if frame.number != number:
                raise self._nonsense(f"an answer to request {frame.number} instead of {number}")
            if frame.kind in (Kind.ANSWER, Kind.REFUSAL):
                return notes, self._link.decoded(frame)
            if frame.kind is not Kind.NOTES:
                raise self._nonsense(f"a message {frame.kind.name}")
            notes = self._link.decoded(frame)

    def _nonsense(self, what: str) -> PhysxError:
        self._link.close(f"it sent {what}")
        return RemoteProtocolError(f"{self._link.name} sent {what}. The connection is closed.")


class PhysxEnv(gymnasium.Env[Any, Any]):
    """One world of a service. Closing it ends the connection.

    Attributes:
        client: The connection, which other worlds may share.
        world: Number of the world.
    """

    def __init__(self, client: PhysxClient, world: int = 0) -> None:
        """Take a world.

        Args:
            client: The connection.
            world: Number of the world.

        Raises:
            ConfigError: There is no such world.
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
        """Begin an episode.

        Args:
            seed: Seed of the world.
            options: Options of the environment, plain values.

        Raises:
            PhysxError: The world raised, or the service is gone or too late.
        """
        super().reset(seed=seed)
        rows = self.client.reset(self._worlds, seeds=[seed], options=options)
        return self.client.observations.row(rows.arrays, 0), rows.infos[0]

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act.

        Raises:
            ActionError: The action has another shape than the space.
            PhysxError: The world raised, or the service is gone or too late.
        """
        client = self.client
        client.ask_step(client.actions.stacked(action, one=True), self._number)
        arrays, infos = client.rows(1)
        return (
            client.observations.row(arrays, 0),
            float(arrays[REWARD][0]),
            bool(arrays[TERMINATED][0]),
            bool(arrays[TRUNCATED][0]),
            infos[0],
        )

    def render(self) -> Any:
        """Return what the world renders."""
        return self.client.render(self.world)

    def snapshot(self) -> int:
        """Keep the world's state: see `PhysxClient.snapshot`."""
        return self.client.snapshot(self.world)

    def restore(self, state: int) -> Any:
        """Put the world back to a snapshot; return the observation of that moment."""
        rows = self.client.restore(state, self.world)
        return self.client.observations.row(rows.arrays, 0)

    def close(self) -> None:
        """End the connection; calling it again does nothing."""
        self.client.close()


def introduced_leaves(told: Mapping[str, Any]) -> tuple[Leaves, Leaves]:
    """Return what a service says about observations and actions."""
    return (
        Leaves(build_space(told["observation_space"]), "observation"),
        Leaves(build_space(told["action_space"]), "action"),
    )
