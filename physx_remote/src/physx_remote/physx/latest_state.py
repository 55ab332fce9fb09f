"""LatestState: the last transition of each world, as arrays that can be sent unchanged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.typing import Array
from physx_remote.errors import RemoteError
from physx_remote.physx.space_arrays import SpaceArrays
from physx_remote.physx.wire import REWARD, TERMINATED, TRUNCATED
from physx_remote.serving.worlds import Transition


class LatestState:
    """The last observation, reward, flags and info of each world.

    Attributes:
        arrays: The arrays by name, each with a leading axis of worlds.
        known: Which worlds have an observation, shape (worlds,).
        infos: The last info of each world.
    """

    def __init__(self, observations: SpaceArrays, count: int) -> None:
        """Allocate the arrays of `count` worlds."""
        self._observations = observations
        self._reward = np.zeros(count)
        self._terminated, self._truncated = np.zeros((2, count), np.bool_)
        parts = observations.zeros(count)
        self._parts = list(parts.values())
        self.arrays: dict[str, Array] = {
            REWARD: self._reward,
            **parts,
            TERMINATED: self._terminated,
            TRUNCATED: self._truncated,
        }
        self.known = np.zeros(count, np.bool_)
        self.infos: list[dict[str, Any]] = [{} for _ in range(count)]

    def put(self, world: int, transition: Transition) -> None:
        """Store the transition of a world."""
        observation, reward, terminated, truncated, info = transition
        try:
            self._observations.put(self._parts, world, observation)
        except (ValueError, TypeError, LookupError) as error:
            raise RemoteError(
                f"The observation {observation!r:.200} is not in the environment's own space "
                f"{self._observations.space}: {error}."
            ) from error
        self._reward[world] = reward
        self._terminated[world], self._truncated[world] = terminated, truncated
        self.infos[world] = info
        self.known[world] = True

    def rows(self, worlds: Sequence[int]) -> dict[str, Array]:
        """Return the rows of some worlds; the arrays themselves for all of them."""
        if len(worlds) == len(self.known) and worlds == [*range(len(worlds))]:
            return self.arrays
        if len(worlds) == 1:
            place = slice(worlds[0], worlds[0] + 1)
            return {name: array[place] for name, array in self.arrays.items()}
        places = np.array(worlds, np.intp)
        return {name: array[places] for name, array in self.arrays.items()}

    def copy(self, world: int) -> dict[str, Array]:
        """Return a copy of one world's rows."""
        return {name: array[world].copy() for name, array in self.arrays.items()}

    def paste(self, world: int, rows: dict[str, Array]) -> None:
        """Set a world's rows to a copy returned by `copy`."""
        for name, value in rows.items():
            self.arrays[name][world] = value
        self.known[world], self.infos[world] = True, {}
