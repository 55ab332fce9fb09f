"""Histories of checkpoints, and what is promised of them."""

from __future__ import annotations

import functools
import random
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from physx_core import Field, NetworkConfig, PhysxError, checkpoint, files
from physx_core.checkpoint import BEST, Checkpoint, Progress
from powercut.disk import Killed, Recorder
from powercut.histories import Part
from powercut.stage import Stage

NAME = "net"
FIELDS = {"x": Field("x", (2,)), "y": Field("y", ())}
PARAMETERS, STATE = "parameters.bin", "optimization.bin"


@functools.lru_cache(100)
def content(number: int, nbytes: int) -> bytes:
    """Return bytes that no other checkpoint has."""
    return random.Random(number).randbytes(nbytes)


def save(folder: Path, number: int, nbytes: int, *, best: bool) -> Path:
    """Save a checkpoint whose files a library writes by itself."""
    network: Any = SimpleNamespace(
        parameters_file=PARAMETERS,
        net_fields=["x"],
        opt_fields=["y"],
        save_parameters=lambda path: path.write_bytes(content(number, nbytes)),
    )
    optimization: Any = SimpleNamespace(
        state_file=STATE,
        save_state=lambda path: path.write_bytes(content(-number, nbytes // 2)),
    )
    config = NetworkConfig("toy/linear", network_name=NAME)
    progress = Progress(number, 0, nbytes, 0)
    return checkpoint.save(folder, config, network, optimization, FIELDS, {}, progress, best=best)


@dataclass
class Seen:
    """What is found of checkpoints.

    Attributes:
        error: Why there is nothing to be found.
        missing: Whether there is no folder.
        found: Name to what it holds: a number, or what is wrong.
        last: What is found if the last is asked for.
    """

    error: str = ""
    missing: bool = False
    found: dict[str, int | str] = field(default_factory=dict)
    last: int | str | None = None


def look(folder: Path) -> Seen:
    """Read all checkpoints."""
    seen = Seen()
    for path in checkpoint.list_all(folder):
        best = path.name.endswith(BEST)
        seen.found[path.name] = _read(path.name, lambda at=path: checkpoint.read(at), best=best)
    numbered = [name for name in seen.found if not name.endswith(BEST)]
    if numbered:
        seen.last = _read("the last", lambda: checkpoint.find(folder, NAME, -1))
    return seen


def _read(what: str, find: Callable[[], Checkpoint], *, best: bool = False) -> int | str:
    """Return the number of a checkpoint that is as it was saved; or else, what is wrong with it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = find()
        number, nbytes = found.progress.epoch, found.progress.batches_read
        if (found.path / PARAMETERS).read_bytes() != content(number, nbytes):
            return f"{what} has other parameters"
        if not best and (found.path / STATE).read_bytes() != content(-number, nbytes // 2):
            return f"{what} has another state"
    except (PhysxError, Warning) as error:
        return f"{what}: {error}"
    except Exception as error:
        return f"{what}: raw {type(error).__name__}: {error}"
    return number


@dataclass(frozen=True)
class Promise:
    """What must be found at one moment.

    Attributes:
        there: Name to what it may hold.
        new: What may also be there: the checkpoint that is being written, and those that were
            when the process was killed.
        made: Whether there is a folder for certain.
        call: The call at work.
    """

    there: Mapping[str, tuple[int, ...]]
    new: Mapping[str, tuple[int, ...]]
    made: bool
    call: str

    def broken(self, seen: Seen, *, power: bool) -> str:
        """Return how what is found breaks the promise; empty if it does not."""
        for name, values in self.there.items():
            if seen.found.get(name) not in values:
                return f"{name} holds {seen.found.get(name)!r}, not one of {values}"
        for name in seen.found.keys() - self.there.keys():
            if seen.found[name] not in self.new.get(name, ()):
                return f"{name} is {seen.found[name]!r}"
        numbered = [v for n, v in seen.found.items() if not n.endswith(BEST)]
        last = max(numbered, default=None)
        return "" if seen.last == last else f"the last one is {seen.last!r}, not {last}"


class CheckpointHistory:
    """Checkpoints that are saved one after another.

    Attributes:
        calls: What was called, for messages.
        problems: What calls did wrong.
        has_free_axes: Whether a field has one: there are none.
    """

    kinds = ("save",)
    has_free_axes = False

    def __init__(
        self, chance: random.Random, stage: Stage, folder: Path, aside: Path, longest: int = 7
    ) -> None:
        self.calls: list[str] = []
        self.problems: list[str] = []
        self._chance, self._stage, self._longest = chance, stage, longest
        self._folder = folder / "session" / "network"
        self._there: dict[str, tuple[int, ...]] = {}
        self._perhaps: dict[str, tuple[int, ...]] = {}
        self._number = self._fuse = -1
        self._made = False

    @staticmethod
    def look(place: Path) -> Seen:
        """Return what is found in a folder that holds a state."""
        return look(place / "session" / "network")

    @staticmethod
    def examine(kind: str, place: Path, seen: Seen) -> str:
        """Save another checkpoint after a cut: all of them are there."""
        folder = place / "session" / "network"
        try:
            files.make_folder(folder.parent)
            for best in (False, True):
                save(folder, 10**6, 600, best=best)
        except Exception as error:
            return f"save: {type(error).__name__}: {error}"
        now = look(folder)
        wanted = {name: 10**6 if name.endswith(BEST) else n for name, n in seen.found.items()}
        lost = {name for name in wanted if now.found.get(name) != wanted[name]}
        if lost or now.last != 10**6:
            return f"save: then {lost} are other ones, and the last one is {now.last}"
        return ""

    def play(self) -> Part:
        """Save some checkpoints."""
        recorder = self._recorder = Recorder(self._folder.parent.parent)
        recorder.before = self._before
        self._promises: list[tuple[int, Any]] = []
        part = Part(recorder.top, recorder.journal, self._promises, self._stage.boot)
        self._mark("nothing")
        with self._stage.recorded(recorder):
            files.make_folder(self._folder.parent)
            self._made = True
            for _ in range(self._chance.randint(1, self._longest)):
                self._save()
        return part

    def go_on(self, seen: Seen, promise: Promise, boot: str) -> None:
        """Go on after a power cut."""
        self.calls.append(f"-- power cut; {boot} --")
        self._there = {name: (n,) for name, n in seen.found.items() if isinstance(n, int)}
        self._perhaps.clear()

    def _save(self) -> None:
        best = self._chance.random() < 0.5
        self._number += 1
        nbytes = self._chance.choice((100, 700, 5000))
        taken = {**self._there, **self._perhaps}
        numbers = [int(n.rpartition("_")[2]) for n in taken if not n.endswith(BEST)]
        name = f"{NAME}_{BEST if best else max(numbers, default=-1) + 1}"
        self.calls.append(f"save {self._number} as {name}, {nbytes} bytes")
        self._mark(self.calls[-1], {name: (*self._perhaps.get(name, ()), self._number)})
        if self._chance.random() < 0.15:
            self._fuse = self._chance.randint(0, 30)
        try:
            saved = save(self._folder, self._number, nbytes, best=best)
            if saved.name != name:
                self.problems.append(f"{saved.name} was saved, not {name}")
            self._there |= self._perhaps
            self._perhaps.clear()
            self._there[name] = (self._number,)
        except Killed:
            self._recorder.bury()
            self._recorder.catch_up()
            seen = look(self._folder)
            problem = self._promises[-1][1].broken(seen, power=False)
            if problem:
                self.problems.append(f"after a kill: {problem}")
            elif name in self._there:
                self._there[name] = (*self._there[name], self._number)
            elif name in seen.found:  # the disk may not have it yet
                self._perhaps[name] = (*self._perhaps.get(name, ()), self._number)
        except Exception as error:
            self.problems.append(f"{self.calls[-1]}: {type(error).__name__}: {error}")
        self._fuse = -1
        self._mark(f"after {self.calls[-1]}")

    def _mark(self, call: str, new: Mapping[str, tuple[int, ...]] | None = None) -> None:
        there = dict(self._there)
        new = self._perhaps | dict(new or {})
        for name in there.keys() & new.keys():
            there[name] = (*there[name], *new.pop(name))
        promise = Promise(there, new, self._made, call)
        self._promises.append((len(self._recorder.journal), promise))

    def _before(self, operation: str) -> None:
        if self._fuse >= 0:
            self._fuse -= 1
            if self._fuse < 0:
                self.calls[-1] += f" KILLED before {operation}"
                self._recorder.kill()
