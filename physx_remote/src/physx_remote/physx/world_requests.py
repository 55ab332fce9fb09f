"""WorldRequests: validates and carries out a physx client's requests to the worlds."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

import numpy as np

from physx_core import PhysxError
from physx_core.clock import Clock
from physx_core.typing import Array
from physx_remote.errors import RequestError
from physx_remote.physx.latest_state import LatestState
from physx_remote.physx.space_arrays import SpaceArrays
from physx_remote.physx.wire import WORLDS
from physx_remote.serving.worlds import Worlds

_SLICE = 0.02


@dataclass
class Change:
    """A change in some worlds; `WorldRequests.latest` has the result once the work is done.

    Attributes:
        worlds: Numbers of the worlds.
        is_reset: Whether new episodes start.
        work: Makes the change; yields the time in s until it resumes.
        actions: The actions of the worlds, as stacked arrays.
    """

    worlds: Sequence[int]
    is_reset: bool
    work: Iterator[float] = field(default_factory=lambda: iter(()))
    actions: Mapping[str, Array] = field(default_factory=dict)


class WorldRequests:
    """Carries out requests; each is validated before anything changes.

    Attributes:
        latest: The last transition of each world.
    """

    def __init__(self, worlds: Worlds, max_snapshots: int, clock: Clock) -> None:
        """Store the worlds."""
        self._clock = clock
        self._worlds = worlds
        self._actions = SpaceArrays(worlds.action_space, "action")
        observations = SpaceArrays(worlds.observation_space, "observation")
        self.latest = LatestState(observations, worlds.num_worlds)
        self._all = list(range(worlds.num_worlds))
        self._snapshots: dict[int, tuple[Any, dict[str, Array]]] = {}
        self._max_snapshots = max_snapshots
        self._numbers = itertools.count(1)

    # Steps and resets -------------------------------------------------------------------------

    def steps(self, arrays: dict[str, Any]) -> Change:
        """Prepare a step of some worlds.

        Args:
            arrays: The actions, and ``worlds`` with the worlds' numbers; by default all worlds.
        """
        chosen = arrays.pop(WORLDS, None)
        worlds = self._all if chosen is None else self._chosen(chosen)
        if arrays.keys() != set(self._actions.names):
            raise RequestError(
                f"Actions must be the arrays {self._actions.names}, not {[*arrays]}."
            )
        self._actions.check(arrays, worlds)
        rows = self._actions.rows(arrays, len(worlds))
        return Change(worlds, False, self._step(worlds, rows), arrays)

    def _step(self, worlds: Sequence[int], actions: Iterable[Any]) -> Iterator[float]:
        step, put, begin = self._worlds.step, self.latest.put, self._clock.monotonic()
        with _Place("step") as place:
            for world, action in zip(worlds, actions, strict=True):
                place.world = world
                put(world, step(world, action))
                if self._clock.monotonic() - begin > _SLICE:
                    yield 0.0
                    begin = self._clock.monotonic()

    def resets(self, request: Mapping[str, Any]) -> Change:
        """Prepare a new episode of some worlds.

        Args:
            request: Any of ``worlds``, a list, ``seeds``, an integer or None for each of them, and
                ``options``.
        """
        chosen = request.get("worlds")
        worlds = self._all if chosen is None else self._chosen(chosen)
        seeds = request.get("seeds")
        seeds = [None] * len(worlds) if seeds is None else seeds
        if not isinstance(seeds, list) or len(seeds) != len(worlds):
            raise RequestError(
                f"seeds must have {len(worlds)} entries, one per world, not {seeds!r:.100}."
            )
        for seed in seeds:
            if seed is not None and (type(seed) is not int or seed < 0):
                raise RequestError(f"A seed must be a non-negative integer, not {seed!r:.60}.")
        options = request.get("options")
        if options is not None and not isinstance(options, dict):
            raise RequestError(f"Reset options must be a dictionary, not {options!r:.60}.")
        return Change(worlds, True, self._reset(worlds, seeds, options))

    def _reset(
        self, worlds: Sequence[int], seeds: Sequence[int | None], options: dict[str, Any] | None
    ) -> Iterator[float]:
        begin = self._clock.monotonic()
        with _Place("reset") as place:
            for world, seed in zip(worlds, seeds, strict=True):
                place.world = world
                observation, info = self._worlds.reset(world, seed, options)
                self.latest.put(world, (observation, 0.0, False, False, info))
                if self._clock.monotonic() - begin > _SLICE:
                    yield 0.0
                    begin = self._clock.monotonic()

    # Snapshots --------------------------------------------------------------------------------

    def restore(self, request: Mapping[str, Any]) -> int:
        """Restore a snapshot, taken in any world, in a world; return the world's number."""
        world, number = self._world(request), request.get("snapshot")
        if not isinstance(number, int) or number not in self._snapshots:
            raise RequestError(
                f"There is no snapshot {number!r:.40}: a snapshot is kept until it is deleted with "
                "forget, or the client that took it leaves."
            )
        state, rows = self._snapshots[number]
        with _Place("restore", world):
            self._worlds.restore(world, state)
        self.latest.paste(world, rows)
        return world

    def forget_snapshots(self) -> None:
        """Delete all snapshots."""
        self._snapshots.clear()

    def answer(self, what: str, request: Mapping[str, Any]) -> Any:
        """Carry out a request that does not change any world, and return the answer."""
        if what == "snapshot":
            return self._snapshot(self._world(request))
        if what == "forget":
            number = request.get("snapshot")
            return isinstance(number, int) and self._snapshots.pop(number, None) is not None
        if what == "render":
            world = self._world(request)
            with _Place("render", world):
                return self._worlds.environments[world].render()
        raise RequestError(
            f'Unknown request "{what}". Known: reset, last, snapshot, restore, forget, render.'
        )

    def _snapshot(self, world: int) -> int:
        if len(self._snapshots) >= self._max_snapshots:
            raise RequestError(
                f"There are already {self._max_snapshots} snapshots: forget some, or serve with a "
                "larger max_snapshots."
            )
        if not self.latest.known[world]:
            raise RequestError(f"World {world} has not started: reset it first.")
        with _Place("snapshot", world):
            state = self._worlds.snapshot(world)
        number = next(self._numbers)
        self._snapshots[number] = (state, self.latest.copy(world))
        return number

    # ------------------------------------------------------------------------------------------

    def _world(self, request: Mapping[str, Any]) -> int:
        return self._chosen([request.get("world", 0)])[0]

    def _chosen(self, given: Any) -> list[int]:
        """Return world numbers as a list, after validating them."""
        if isinstance(given, np.ndarray) and given.ndim == 1 and given.dtype.kind in "iu":
            given = given.tolist()
        count = len(self._all)
        is_list = isinstance(given, list) and len(given) > 0
        is_known = is_list and all(type(n) is int and 0 <= n < count for n in given)
        if not is_known or len(set(given)) < len(given):
            raise RequestError(
                f"Worlds must be a list of distinct numbers from 0 to {count - 1}, not "
                f"{given!r:.100}."
            )
        return list(given)


def wrap_error(error: Exception, place: str = "") -> RequestError:
    """Wrap an error of the environment's code in one that clients know, with its traceback."""
    told = RequestError(f"{place}{type(error).__name__}: {error}")
    told.__cause__ = error
    return told


class _Place:
    """A context manager that adds the world to errors.

    Attributes:
        world: Number of the current world.
    """

    def __init__(self, what: str, world: int = 0) -> None:
        self.world = world
        self._what = what

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(error, PhysxError):
            error.add_note(f"World {self.world} of the service, in {self._what}().")
        elif isinstance(error, Exception):
            raise wrap_error(error, f"World {self.world} failed in {self._what}(): ") from error
