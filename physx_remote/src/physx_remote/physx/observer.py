"""PhysxObserver: observes the worlds of a service while another client drives them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from physx_core import Closeable
from physx_core.net import Frame, Kind, pack_value, parse_address
from physx_core.typing import Array
from physx_remote.errors import RemoteProtocolError
from physx_remote.physx.client import fit_outcome, read_introduction
from physx_remote.physx.link import PhysxLink
from physx_remote.physx.space_arrays import is_array
from physx_remote.physx.wire import (
    COUNT,
    IS_RESET,
    OBSERVE,
    REWARD,
    TERMINATED,
    TRUNCATED,
    WORLDS,
    split_infos,
)
from physx_remote.serving.connect_options import TokenOptions
from physx_remote.serving.spaces import MALFORMED_INPUT_ERRORS


@dataclass(frozen=True)
class Seen:
    """A change in some worlds. The arrays have a leading axis of these worlds.

    Attributes:
        number: Number of requests that have changed worlds so far, including skipped ones.
        worlds: Numbers of the worlds.
        is_reset: Whether their episodes started with this change.
        observation: Value of the batched observation space.
        action: Value of the batched action space; None after a reset, and in `PhysxObserver.last`.
        reward: Rewards.
        terminated: Whether each episode was terminated.
        truncated: Whether each episode was truncated.
        infos: Info of each world.
    """

    number: int
    worlds: Array
    is_reset: bool
    observation: Any
    action: Any
    reward: Array
    terminated: Array
    truncated: Array
    infos: list[dict[str, Any]]


class PhysxObserver(Closeable):
    """Receives the results of the acting client's requests. A context manager.

    An observer that does not keep up skips results and continues with the latest state of all
    worlds.

    Attributes:
        num_worlds: Number of worlds.
        observation_space: Space of one world's observations.
        action_space: Space of one world's actions.
    """

    def __init__(self, address: tuple[str, int] | str, **options: Unpack[TokenOptions]) -> None:
        """Connect.

        Args:
            address: Host and port, or ``"host:port"``.
            options: See `TokenOptions`.

        Raises:
            ConfigError: If there is no token.
            RemoteError: If nothing answers, or the tokens differ.
        """
        place = parse_address(address) if isinstance(address, str) else address
        self._link = PhysxLink(place, OBSERVE, **options)
        told = read_introduction(self._link)
        self._observations, self._actions = told.observations, told.actions
        self.observation_space = self._observations.space
        self.action_space = self._actions.space
        self.num_worlds = told.num_worlds
        self._notes: Frame | None = None
        self._asked = 0

    def next(self, timeout: float | None = None) -> Seen | None:
        """Wait for the next change.

        Args:
            timeout: Time to wait in s; None: forever.

        Returns:
            The change; None if there was none in time.

        Raises:
            RemoteClosedError: If the service has closed the connection.
        """
        while True:
            frame = self._link.look(timeout)
            if frame is None:
                return None
            if frame.kind is Kind.SEEN:
                return self._seen(frame)
            if frame.kind is not Kind.NOTES:
                raise self._protocol_error(frame)
            self._notes = frame

    def last(self) -> Seen:
        """Return the latest state of all worlds that have started; earlier changes are skipped.

        Raises:
            RemoteError: If the service has closed the connection, or does not answer in time.
        """
        self._asked += 1
        self._link.send(pack_value(Kind.REQUEST, {"do": "last"}, "request", self._asked))
        while True:
            frame = self._link.receive()
            if frame.kind in (Kind.ANSWER, Kind.REFUSAL):
                return self._seen(frame)
            self._notes = frame if frame.kind is Kind.NOTES else None

    def close(self) -> None:
        """Close the connection; calling it again does nothing."""
        self._link.close()

    def _seen(self, frame: Frame) -> Seen:
        arrays: Mapping[str, Any] = self._link.decode(frame)
        notes, self._notes = self._notes, None
        try:
            worlds = arrays[WORLDS]
            count = len(worlds)
            has_actions = any(name in arrays for name in self._actions.names)
            if not (
                is_array(worlds, np.dtype(np.int64), (count,))
                and fit_outcome(arrays, count)
                and self._observations.fit(arrays, count)
                and (not has_actions or self._actions.fit(arrays, count))
            ):
                raise ValueError("arrays of other worlds or spaces")
            infos: list[dict[str, Any]] = [{} for _ in range(count)]
            if notes is not None and notes.number == frame.number:
                infos, _ = split_infos(self._link.decode(notes), count)
            return Seen(
                number=int(arrays.get(COUNT, frame.number)),
                worlds=worlds,
                is_reset=bool(arrays[IS_RESET]),
                observation=self._observations.batch(arrays),
                action=self._actions.batch(arrays) if has_actions else None,
                reward=arrays[REWARD],
                terminated=np.asarray(arrays[TERMINATED]),
                truncated=np.asarray(arrays[TRUNCATED]),
                infos=infos,
            )
        except MALFORMED_INPUT_ERRORS as error:
            raise self._protocol_error(frame) from error

    def _protocol_error(self, frame: Frame) -> RemoteProtocolError:
        self.close()
        return RemoteProtocolError(
            f"{self._link.name} sent a message {frame.kind.name} that is not valid for observers."
        )
