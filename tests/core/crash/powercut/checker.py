"""Opens every state that a history may leave, and compares it with what was promised."""

from __future__ import annotations

import faulthandler
import gc
import itertools
import random
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from powercut.checkpoints import CheckpointHistory
from powercut.disk import Disk, Folder, Tree
from powercut.histories import History, Part
from powercut.promises import Promise, Seen
from powercut.stage import Stage

NEXT_BOOT = "boot 9"
"""What tells the machine's next run from others; as long as theirs, as in reality."""
LONGEST = 60.0
"""Seconds after which looking at a hundred states counts as endless."""
CHECKPOINTS = 0.1
"""Share of the histories that save checkpoints."""
DEEP = 16
"""Of so many different states, one is also verified, written to, repaired or rebuilt."""
KILLS = 3
"""Of so many moments, one is also that of a kill of the process, after which nothing is lost."""
STATES = 600
"""About how many states of one history are built."""
UNREAD = ("dataset.lock", "dataset.json.lock")
"""Files whose content makes no difference."""


@dataclass(frozen=True)
class Problem:
    """A state that breaks a promise.

    Attributes:
        place: What replays it: seed, part, moment and number of the choice.
        what: How it breaks the promise.
        plan: What was on the disk.
        calls: The history.
    """

    place: str
    what: str
    plan: str
    calls: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.place}: {self.what}\n    {self.plan}"


@dataclass
class Result:
    """What a campaign found.

    Attributes:
        examined: How many states were compared with a promise.
        distinct: How many different ones there were in each history, all together.
        free: How many of those are of data with free axes.
        histories: How many histories.
        problems: What was wrong.
        deep: How many states were also recovered or repaired, by kind.
    """

    examined: int = 0
    distinct: int = 0
    free: int = 0
    histories: int = 0
    problems: list[Problem] = field(default_factory=list)
    deep: Counter[str] = field(default_factory=Counter)

    def add(self, other: Result) -> None:
        """Add what another campaign found."""
        self.examined += other.examined
        self.distinct += other.distinct
        self.free += other.free
        self.histories += other.histories
        self.problems += other.problems
        self.deep += other.deep


class Checker:
    """Plays histories and examines their states.

    Attributes:
        result: What was found.
    """

    def __init__(
        self,
        root: Path,
        states: int = STATES,
        checkpoints: float = CHECKPOINTS,
        told: str = "",
    ) -> None:
        """Examine nothing yet.

        Args:
            root: A folder that becomes the checker's own.
            states: About how many states of each history are built.
            checkpoints: Share of the histories that save checkpoints.
            told: Place of a state of which everything is printed.
        """
        self._told = told
        self.result = Result()
        self._checkpoints = checkpoints
        self._work, self._aside = root / "work", root / "aside"
        self._state = Folder(root / "state")
        self._states = states

    def check(self, seed: int) -> Result:
        """Examine the history that a seed stands for; return what was found in it."""
        try:
            return self._check(seed)
        finally:
            WATCH.end()

    def _check(self, seed: int) -> Result:
        result = Result(histories=1)
        gc.collect()
        gc.freeze()
        for folder in (self._work, self._aside):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        chance, stage = random.Random(seed), Stage()
        with stage.entered():
            kind = CheckpointHistory if chance.random() < self._checkpoints else History
            history = kind(chance, stage, self._work, self._aside)
            for number in range(3):
                part = history.play()
                place = f"{seed}/{number}"
                result.problems += [
                    Problem(place, text, "the calls themselves", tuple(history.calls))
                    for text in history.problems
                ]
                examined = _Part(place, part, history, self._state, self._states, result)
                with Stage().entered():
                    examined.run()
                    if self._told.startswith(place + "/"):
                        examined.tell(*map(int, self._told.split("/")[2:]))
                if result.problems or chance.random() < 0.5:
                    break
                with Stage().entered():
                    cut = examined.draw(chance)
                if cut is None:
                    break
                tree, seen, promise = cut
                Folder(self._work).become(tree)
                history.go_on(seen, promise, f"boot {number + 1}")
        self.result.add(result)
        return result


class Watch:
    """Ends the process if some states cannot be examined in a reasonable time."""

    def __init__(self) -> None:
        self.place = ""
        self._left = 0

    def look_at(self, place: str) -> None:
        """Note which state is being examined."""
        self.place = place
        self._left -= 1
        if self._left < 0:
            self._left = 100
            faulthandler.dump_traceback_later(LONGEST, exit=True)

    def end(self) -> None:
        """Let the process live on: nothing is examined for now."""
        self._left = 0
        faulthandler.cancel_dump_traceback_later()


WATCH = Watch()


class _Part:
    """The states of one part of a history."""

    def __init__(
        self,
        place: str,
        part: Part,
        history: Any,
        folder: Folder,
        states: int,
        result: Result,
    ) -> None:
        self._history = history
        self._place, self._part, self._folder = place, part, folder
        self._result = result
        self._each = max(3, states // max(1, len(part.journal)))
        self._seen: dict[int, Seen] = {}
        self._compared: set[tuple[int, int, bool]] = set()

    def run(self) -> None:
        """Examine states of all moments."""
        disk = Disk(self._part.top, self._part.journal)
        for moment, promise in self._moments():
            disk.advance(moment)
            same = 0
            for number, choice in enumerate(disk.choices(self._chance(moment))):
                if number >= self._each + 5 or same > 4:
                    break
                problem = self._examine(disk.build(choice), promise, moment, number)
                same = 0 if problem is not None else same + 1
                if problem:
                    place = f"{self._place}/{moment}/{number}"
                    plan = f"{choice.plan}, in {promise.call!r}"
                    problem = Problem(place, problem, plan, tuple(self._history.calls))
                    self._result.problems.append(problem)
                    if len(self._result.problems) > 20:
                        return

    def draw(self, chance: random.Random) -> tuple[Tree, Seen, Promise] | None:
        """Choose a state by chance, as the one to go on from."""
        moments = [(m, p) for m, p in self._moments() if p.made]
        if not moments:
            return None
        moment, promise = chance.choice(moments)
        disk = Disk(self._part.top, self._part.journal)
        disk.advance(moment)
        wanted = chance.randint(0, 20)
        choices = disk.choices(self._chance(moment))
        tree = disk.build(next(itertools.islice(choices, wanted, None)))
        return tree, self._look(tree, _key(tree), power=True), promise

    def tell(self, moment: int, number: int) -> None:
        """Print what led to a state and what it holds."""
        calls = dict(reversed([(start, p.call) for start, p in self._part.promises]))
        for at, operation in enumerate(self._part.journal[: moment + 1]):
            if at in calls:
                print(f"-- {calls[at]}")
            print(f"{at:5} {'(not begun) ' * (at == moment)}{operation}")
        disk = Disk(self._part.top, self._part.journal)
        disk.advance(moment)
        choice = next(itertools.islice(disk.choices(self._chance(moment)), number, None))
        tree = disk.build(choice)
        print(f"cut: {choice.plan}; names that have changed: {choice.names}")
        for name, content in sorted(tree.items()):
            print(f"  {name}: {'folder' if content is None else f'{len(content)} bytes'}")
        print(f"seen: {self._look(tree, _key(tree), _is_cut(moment, number))}")

    def _moments(self) -> Iterator[tuple[int, Promise]]:
        """Yield each moment with what is promised then."""
        promises, last = self._part.promises, len(self._part.journal)
        for number, (start, promise) in enumerate(promises):
            end = promises[number + 1][0] if number + 1 < len(promises) else last
            for moment in range(start, end + 1):
                yield moment, promise

    def _chance(self, moment: int) -> object:
        seed = hash((int(self._place.split("/")[0]), moment))
        return lambda number: random.Random(seed * 1000 + number)

    def _examine(self, tree: Tree, promise: Promise, moment: int, number: int) -> str | None:
        """Return what is wrong with a state, empty if nothing, None if it is known already."""
        key, power = _key(tree), _is_cut(moment, number)
        if (key, id(promise), power) in self._compared:
            return None
        self._compared.add((key, id(promise), power))
        new = key not in self._seen and power
        self._result.examined += 1
        WATCH.look_at(f"{self._place}/{moment}/{number}")
        seen = self._look(tree, key, power)
        problem = promise.broken(seen, power=power)
        if new:
            self._result.distinct += 1
            self._result.free += self._history.has_free_axes
            if not problem and not seen.error and self._result.distinct % DEEP == 0:
                kinds = self._history.kinds
                kind = kinds[self._result.distinct // DEEP % len(kinds)]
                self._result.deep[kind] += 1
                problem = self._history.examine(kind, self._folder.path, seen)
                if kind != "verify":
                    self._folder.touched()
        return problem

    def _look(self, tree: Tree, key: int, power: bool) -> Seen:
        key = key if power else ~key
        if key not in self._seen:
            self._folder.become(tree)
            Stage.now.boot = NEXT_BOOT if power else self._part.boot
            self._seen[key] = self._history.look(self._folder.path)
        return self._seen[key]


def _is_cut(moment: int, number: int) -> bool:
    """Return whether the power is cut; otherwise the process is killed and the disk is as it is."""
    return number > 0 or moment % KILLS != 0


def _key(tree: Tree) -> int:
    """Return what is the same for equal states only."""
    return hash(
        frozenset(
            (place, content)
            for place, content in tree.items()
            if place.rpartition("/")[2] not in UNREAD
        )
    )


def campaign(seeds: Iterator[int], root: Path, seconds: float) -> Result:
    """Examine histories until the time is over.

    Args:
        seeds: What they are drawn from.
        root: A folder for everything.
        seconds: How long.
    """
    checker, end = Checker(root), time.monotonic() + seconds
    for seed in seeds:
        checker.check(seed)
        if time.monotonic() > end:
            break
    return checker.result


def replay(place: str, root: Path) -> list[Problem]:
    """Examine one history again; tell what led to one of its states, and what it holds.

    Args:
        place: A seed, or the place of a problem.
        root: A folder for everything.

    Returns:
        What is wrong there, or in the whole history if only a seed is given.
    """
    seed, _, rest = place.partition("/")
    checker = Checker(root, told=place)
    found = checker.check(int(seed)).problems
    return [problem for problem in found if not rest or problem.place == place]
