"""What a client of the protocol physx may have the worlds do."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

import numpy as np

from physx_core import PhysxError
from physx_core.errors import RequestError
from physx_core.typing import Array
from physx_remote.physx.board import Board
from physx_remote.physx.wire import WORLDS, Leaves
from physx_remote.serving.worlds import Worlds

_SLICE = 0.02


@dataclass
class Outcome:
    """Something that changes worlds; what became of them is on the board once it is done.

    Attributes:
        worlds: Which ones.
        is_reset: Whether they begin anew.
        work: Does it; yields, after a while, how long to leave it alone, in s.
        actions: What they were given, as stacked arrays.
    """

    worlds: Sequence[int]
    is_reset: bool
    work: Iterator[float] = field(default_factory=lambda: iter(()))
    actions: Mapping[str, Array] = field(default_factory=dict)


class Requests:
    """Carries out requests, each checked before anything is done.

    Attributes:
        board: What became last of each world.
    """

    def __init__(self, worlds: Worlds, max_snapshots: int) -> None:
        """Keep the worlds.

        Raises:
            UsageError: A space has no fixed layout.
        """
        self._worlds = worlds
        self._actions = Leaves(worlds.action_space, "action")
        self.board = Board(Leaves(worlds.observation_space, "observation"), worlds.num_worlds)
        self._all = list(range(worlds.num_worlds))
        self._snapshots: dict[int, tuple[Any, dict[str, Array]]] = {}
        self._max_snapshots = max_snapshots
        self._numbers = itertools.count(1)

    # Worlds that go on ------------------------------------------------------------------------

    def steps(self, arrays: dict[str, Any]) -> Outcome:
        """Prepare a step of some worlds.

        Args:
            arrays: The actions, and ``worlds`` with the worlds' numbers; without it all of them.

        Raises:
            RequestError: There is no such world, or an action is not of the space.
        """
        chosen = arrays.pop(WORLDS, None)
        worlds = self._all if chosen is None else self._chosen(chosen)
        if arrays.keys() != set(self._actions.names):
            raise RequestError(f"Actions need the arrays {self._actions.names}, not {[*arrays]}.")
        self._actions.check(arrays, len(worlds))
        rows = self._actions.rows(arrays, len(worlds))
        return Outcome(worlds, False, self._stepped(worlds, rows), arrays)

    def _stepped(self, worlds: Sequence[int], actions: Iterable[Any]) -> Iterator[float]:
        step, put, begin = self._worlds.step, self.board.put, time.monotonic()
        with _Place("step") as place:
            for world, action in zip(worlds, actions, strict=True):
                place.world = world
                put(world, step(world, action))
                if time.monotonic() - begin > _SLICE:
                    yield 0.0
                    begin = time.monotonic()

    def resets(self, request: Mapping[str, Any]) -> Outcome:
        """Prepare a new episode of some worlds.

        Args:
            request: Any of ``worlds``, a list, ``seeds``, one for each of them or None, and
                ``options``.

        Raises:
            RequestError: There is no such world, or a value is none.
        """
        chosen = request.get("worlds")
        worlds = self._all if chosen is None else self._chosen(chosen)
        seeds = request.get("seeds")
        seeds = [None] * len(worlds) if seeds is None else seeds
        if not isinstance(seeds, list) or len(seeds) != len(worlds):
            raise RequestError(f"{len(worlds)} worlds need as many seeds, and not {seeds!r:.100}.")
        for seed in seeds:
            if seed is not None and (type(seed) is not int or seed < 0):
                raise RequestError(f"A seed is a whole number of at least 0, not {seed!r:.60}.")
        options = request.get("options")
        if options is not None and not isinstance(options, dict):
            raise RequestError(f"Options of a reset are a dictionary, not {options!r:.60}.")
        return Outcome(worlds, True, self._begun(worlds, seeds, options))

    def _begun(
        self, worlds: Sequence[int], seeds: Sequence[int | None], options: dict[str, Any] | None
    ) -> Iterator[float]:
        begin = time.monotonic()
        with _Place("reset") as place:
            for world, seed in zip(worlds, seeds, strict=True):
                place.world = world
                observation, info = self._worlds.reset(world, seed, options)
                self.board.put(world, (observation, 0.0, False, False, info))
                if time.monotonic() - begin > _SLICE:
                    yield 0.0
                    begin = time.monotonic()

    # Snapshots --------------------------------------------------------------------------------

    def restore(self, request: Mapping[str, Any]) -> int:
        """Put a world back to a snapshot, of itself or of another world; return its number.

        Raises:
            RequestError: There is no such world or snapshot.
        """
        world, number = self._world(request), request.get("snapshot")
        if not isinstance(number, int) or number not in self._snapshots:
            raise RequestError(
                f"There is no snapshot {number!r:.40}: snapshots are kept until they are "
                "forgotten, or the client that took them leaves."
            )
        state, rows = self._snapshots[number]
        with _Place("restore", world):
            self._worlds.restore(world, state)
        self.board.paste(world, rows)
        return world

    def forget_snapshots(self) -> None:
        """Forget all snapshots."""
        self._snapshots.clear()

    def answer(self, what: Any, request: Mapping[str, Any]) -> Any:
        """Do what changes no world, and return the answer.

        Raises:
            RequestError: There is no such request, or it cannot be carried out.
        """
        if what == "snapshot":
            return self._snapshot(self._world(request))
        if what == "forget":
            return self._snapshots.pop(request.get("snapshot", 0), None) is not None
        if what == "render":
            world = self._world(request)
            with _Place("render", world):
                return self._worlds.environments[world].render()
        raise RequestError(
            f'There is no request "{what}". There are: reset, last, snapshot, restore, forget and '
            "render."
        )

    def _snapshot(self, world: int) -> int:
        if len(self._snapshots) >= self._max_snapshots:
            raise RequestError(
                f"{self._max_snapshots} snapshots are kept already: forget some, or serve with a "
                "greater max_snapshots."
            )
        if not self.board.known[world]:
            raise RequestError(f"World {world} has not begun yet: reset it first.")
        with _Place("snapshot", world):
            state = self._worlds.snapshot(world)
        number = next(self._numbers)
        self._snapshots[number] = (state, self.board.copy(world))
        return number

    # ------------------------------------------------------------------------------------------

    def _world(self, request: Mapping[str, Any]) -> int:
        return self._chosen([request.get("world", 0)])[0]

    def _chosen(self, given: Any) -> list[int]:
        """Return the numbers of worlds.

        Raises:
            RequestError: There is none, one does not exist, or one is named twice.
        """
        if isinstance(given, np.ndarray) and given.ndim == 1 and given.dtype.kind in "iu":
            given = given.tolist()
        count = len(self._all)
        is_list = isinstance(given, list) and len(given) > 0
        if not is_list or not all(type(n) is int and 0 <= n < count for n in given):
            is_list = False
        if not is_list or len(set(given)) < len(given):
            raise RequestError(
                f"Worlds are a list of different numbers from 0 to {count - 1}, not {given!r:.100}."
            )
        return list(given)


def reported(error: Exception, place: str = "") -> RequestError:
    """Return an error of somebody's code as one that clients know; the traceback stays with it."""
    told = RequestError(f"{place}{type(error).__name__}: {error}")
    told.__cause__ = error
    return told


class _Place:
    """A context in which errors say in which world they were.

    Attributes:
        world: Number of the world at work.
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
            error.add_note(f"This was world {self.world} of the service, in {self._what}().")
        elif isinstance(error, Exception):
            raise reported(error, f"World {self.world} failed in {self._what}(): ") from error
