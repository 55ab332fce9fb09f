"""Histories of calls, drawn by chance, and what is promised at each moment of them."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import Dataset, Field
from powercut import deep
from powercut.disk import Killed, Node, Operation, Recorder
from powercut.promises import (
    VERSIONS,
    Decoded,
    ModePromise,
    Promise,
    Seen,
    Stream,
    Versions,
    World,
    encode,
    look,
    read,
    width,
)
from powercut.stage import Stage

KINDS = (
    Field("x", (2,), unit="m"),
    Field("n", (), "int32", role="additional"),
    Field("wide", (75,)),
    Field("s", (3,), "float32", unit="N"),
    Field("k", (1, 2), "int64"),
    Field("none", (0,)),
    Field("p", ("node", 2), unit="m"),
    Field("q", ("node",), "float32"),
    Field("e", ("edge", 2), "int64"),
)
HEADER = 2**14
LONGEST = 14


class Broken(Exception):
    """A call did what it must not do."""


class _Stream:
    """Rows by one writer: all, and how many are stored and kept."""

    def __init__(self, rows: list[int], sure: bool = False) -> None:
        self.rows = rows
        self.stored = self.kept = len(rows) if sure else 0

    def promise(self) -> Stream:
        """Return what is promised of them."""
        return Stream(np.array(self.rows, np.int64), self.kept, self.stored)


class _Mode:
    """One mode: its fields, its streams by writer, and whether it is there for certain."""

    def __init__(self, fields: tuple[Field, ...]) -> None:
        self.fields = fields
        self.streams: dict[Any, _Stream] = {}
        self.certain = False

    def promise(self) -> ModePromise:
        """Return what is promised of it."""
        streams = tuple(stream.promise() for stream in self.streams.values())
        return ModePromise(self.fields, streams, self.certain)

    def copy(self) -> _Mode:
        """Return a copy."""
        other = _Mode(self.fields)
        other.certain = self.certain
        for writer, stream in self.streams.items():
            other.streams[writer] = _Stream(list(stream.rows))
            other.streams[writer].stored = stream.stored
            other.streams[writer].kept = stream.kept
        return other


@dataclass
class _World:
    modes: dict[str, _Mode]
    info: dict[str, Any]

    def promise(self) -> World:
        """Return what is promised."""
        modes = {name: mode.promise() for name, mode in self.modes.items()}
        return World(modes, dict(self.info))

    def copy(self) -> _World:
        """Return a copy."""
        return _World({name: mode.copy() for name, mode in self.modes.items()}, dict(self.info))


class Model:
    """What is in a dataset, and what of it is promised.

    Attributes:
        durable: Whether whatever returned is kept.
        now: What is there.
        next: What is there once the call at work has done it all, if it does all or nothing.
        also: What may be on the disk instead, since the process was killed.
        made: Whether the dataset is there for certain.
        versions: Versions by mode and field.
        updates: How many updates there were.
    """

    def __init__(self) -> None:
        self.durable = False
        self.now = _World({}, {})
        self.next: _World | None = None
        self.also: tuple[World, ...] = ()
        self.made = False
        self.versions: dict[tuple[str, str], Versions] = {}
        self.updates = 0
        self.last_row = 0

    def new_rows(self, count: int) -> list[int]:
        """Return rows that were never there."""
        self.last_row += count
        return list(range(self.last_row - count + 1, self.last_row + 1))

    def promise(self, call: str) -> Promise:
        """Return what is promised now."""
        worlds = (self.now.promise(), *self.also)
        if self.next is not None:
            worlds += (self.next.promise(),)
        return Promise(worlds, dict(self.versions), self.made, call)

    def store(self, writer: int | None = None) -> None:
        """All rows of a writer, or all, are stored; and kept, if that is promised."""
        for mode in self.now.modes.values():
            for owner, stream in mode.streams.items():
                if writer is None or owner in (0, writer):
                    stream.stored = len(stream.rows)
                    if self.durable:
                        stream.kept = stream.stored

    def keep(self) -> None:
        """All rows are stored and kept."""
        for mode in self.now.modes.values():
            for stream in mode.streams.values():
                stream.kept = stream.stored = len(stream.rows)

    def keep_stored(self) -> None:
        """The stored rows are kept; of single samples, a writer that died may have had more."""
        for mode in self.now.modes.values():
            for stream in mode.streams.values():
                stream.kept = stream.stored

    def keep_updates(self) -> None:
        """All updates are kept."""
        for key, limits in self.versions.items():
            self.versions[key] = Versions(limits.stored, limits.stored, limits.newest)

    def begin_update(self, mode: str, names: list[str], rows: list[int]) -> int:
        """Let rows of some fields have another version from now on; return it."""
        self.updates += 1
        for name in names:
            of = next(each for each in self.now.modes[mode].fields if each.name == name)
            limits = self._sized((mode, name), width(of))
            newest = limits.newest.copy()
            newest[rows] = self.updates
            self.versions[mode, name] = Versions(limits.kept, limits.stored, newest)
        return self.updates

    def end_update(self, mode: str, names: list[str], rows: list[int]) -> None:
        """The update has returned."""
        for key in ((mode, name) for name in names):
            limits = self.versions[key]
            stored, kept = limits.stored.copy(), limits.kept.copy()
            stored[rows] = limits.newest[rows]
            if self.durable:
                kept[rows] = stored[rows]
            self.versions[key] = Versions(kept, stored, limits.newest)

    def pin(self, seen: Seen) -> None:
        """All numbers stay as they are."""
        self.versions = {
            (mode, name): _exactly(found, self.last_row)
            for mode, fields in seen.decoded.items()
            for name, found in fields.items()
        }

    def adopt(self, seen: Seen, promise: Promise, *, power: bool) -> None:
        """Go on from what is there after a cut or a kill."""
        world = next(w for w in promise.worlds if not _differs_from(w, seen, promise, power))
        modes = {}
        for name in seen.fields:
            mode = modes[name] = _Mode(world.modes[name].fields)
            mode.certain = power or world.modes[name].certain
            rows = seen.rows(name)
            if power:
                mode.streams[0] = _Stream(rows.tolist(), sure=True)
                continue
            for number, stream in enumerate(world.modes[name].streams):
                there = rows[np.isin(rows, stream.rows)].tolist()
                left = mode.streams[-number] = _Stream(there, sure=True)
                left.kept = min(stream.kept, len(there))
        self.also = () if power else promise.worlds  # the disk may not know how it ended
        self.now, self.next = _World(modes, dict(seen.info)), None
        self.made = True
        if power:
            self.pin(seen)

    def _sized(self, key: tuple[str, str], width: int) -> Versions:
        limits = self.versions.get(key)
        empty = np.zeros((self.last_row + 1, width), np.int8)
        if limits is None:
            return Versions(empty, empty, empty)

        def grown(array: Any) -> Any:
            out = empty.copy()
            out[: len(array)] = array
            return out

        return Versions(grown(limits.kept), grown(limits.stored), grown(limits.newest))


def _exactly(found: Decoded, last_row: int) -> Versions:
    array = np.zeros((last_row + 1, found.versions.shape[1]), np.int8)
    array[found.rows] = found.versions
    return Versions(array, array, array)


def _differs_from(world: World, seen: Seen, promise: Promise, power: bool) -> str:
    only = Promise((world,), promise.versions, promise.made, promise.call)
    return only.broken(seen, power=power)


# Histories --------------------------------------------------------------------------------------


@dataclass
class Part:
    """What happened between two power cuts.

    Attributes:
        top: The recorder's top folder.
        journal: What happened on the disk.
        promises: From which operation on what is promised.
        boot: What tells this run of the machine from others.
    """

    top: Node
    journal: list[Operation]
    promises: list[tuple[int, Promise]]
    boot: str


class History:
    """Calls drawn by chance.

    Attributes:
        calls: What was called, for messages.
        problems: What calls did wrong.
        has_free_axes: Whether a field has one.
    """

    kinds = ("verify", "write", "verify", "write", "repair", "write", "verify", "rebuild")

    def __init__(
        self, chance: random.Random, stage: Stage, folder: Path, aside: Path, longest: int = LONGEST
    ) -> None:
        """Draw what all calls have in common.

        Args:
            chance: What draws.
            stage: Where the calls are done.
            folder: An empty folder for the dataset.
            aside: Another one, which is not recorded.
            longest: Number of calls.
        """
        self.calls: list[str] = []
        self.problems: list[str] = []
        self._chance, self._stage = chance, stage
        self._folder, self._aside = folder / "data", aside
        self._longest = longest
        self._modes = {
            name: tuple(chance.sample(KINDS, chance.choice((1, 1, 2, 2, 3))))
            for name in chance.choice((["training"], ["training"], ["training", "test"]))
        }
        if all(0 in of.shape for fields in self._modes.values() for of in fields):
            self._modes = {name: (KINDS[0], *fields) for name, fields in self._modes.items()}
        self._modes = {
            name: fields if any(0 not in of.shape for of in fields) else (KINDS[1], *fields)
            for name, fields in self._modes.items()
        }
        self.has_free_axes = any(of.free_axis for fields in self._modes.values() for of in fields)
        self._capacity = chance.choice((2, 5, 9, 30, 70))
        self._draw_options()
        self._eager = chance.choice((0.0, 0.0, 0.02, 0.1))
        self._model = Model()
        self._next_writer = 0
        self._writers: dict[int, Dataset] = {}
        self._busy = False
        self._fuse = -1
        self._sources = 0

    @staticmethod
    def look(place: Path) -> Seen:
        """Return what is read in a folder that holds a state."""
        return look(place / "data")

    @staticmethod
    def examine(kind: str, place: Path, seen: Seen) -> str:
        """Do more with a state than read it: see `deep.examine`."""
        return deep.examine(kind, place / "data", seen)

    def play(self) -> Part:
        """Make the calls until the end, or until the process cannot go on; return what happened."""
        recorder = self._recorder = Recorder(self._folder.parent)
        recorder.before = self._before
        self._promises: list[tuple[int, Promise]] = []
        self._calling = "nothing"
        self._mark()
        part = Part(recorder.top, recorder.journal, self._promises, self._stage.boot)
        with self._stage.recorded(recorder):
            for _ in range(self._chance.randint(3, self._longest)):
                self._step()
                if self.problems:
                    break
            self._leave()
        return part

    def go_on(self, seen: Seen, promise: Promise, boot: str) -> None:
        """Go on after a power cut that left what is in the folder now."""
        self._stage.boot = boot
        self._model.adopt(seen, promise, power=True)
        self._modes |= {name: mode.fields for name, mode in self._model.now.modes.items()}
        self.calls.append(f"-- power cut; {boot} --")

    # Choosing calls -------------------------------------------------------------------------

    def _step(self) -> None:
        chance = self._chance
        if not self._model.made:
            self._call("create", self._create)
            return
        if not self._writers:
            choices = ["open"] * 6 + ["repair", "repair", "rebuild"]
            self._call(chance.choice(choices), None)
            return
        if self._shared and len(self._writers) == 1 and chance.random() < 0.3:
            self._call("join", self._open_another)
            return
        if chance.random() < 0.05:
            self._fuse = chance.randint(0, 25)
        name = chance.choices(_CALLS, _WEIGHTS)[0]
        if self._shared and name in ("update", "remove", "normalize"):
            name = "append"
        self._call(name, None)

    def _call(self, name: str, function: Callable[[], None] | None) -> None:
        self._calling = name
        number = len(self.calls)
        self.calls.append(name)
        try:
            (function or getattr(self, f"_{name}"))()
        except Killed:
            self._die()
        except Exception as error:
            self.calls[number] += f" -> {type(error).__name__}"
            self.problems.append(f"{self.calls[number]}: {type(error).__name__}: {error}")
        self._model.next = None if not self.problems else self._model.next
        self._calling = f"after {name}"
        self._mark()

    def _told(self, text: str) -> None:
        """Say more of the call, and that it begins."""
        self.calls[-1] = self._calling = f"{self.calls[-1]} {text}"
        self._mark()

    def _mark(self) -> None:
        self._promises.append((len(self._recorder.journal), self._model.promise(self._calling)))

    def _before(self, operation: str) -> None:
        """Let the background work between any two operations, or the process die."""
        if self._fuse >= 0:
            self._fuse -= 1
            if self._fuse < 0:
                self.calls[-1] += f" KILLED before {operation}"
                self._recorder.kill()
        if self._busy or not self._eager or self._chance.random() >= self._eager:
            return
        self._busy = True
        try:
            self._background()
        finally:
            self._busy = False

    def _background(self) -> None:
        waiting = [e for e in self._stage.executors if e.waiting]
        if waiting and self._chance.random() < 0.5:
            self.calls[-1] += " (sealing)"
            self._chance.choice(waiting).work()
        elif not any(syncer.busy for syncer in self._stage.syncers):
            self.calls[-1] += " (tick)"
            self._sync()

    # Calls ----------------------------------------------------------------------------------

    def _draw_options(self) -> None:
        self._durable = self._chance.random() < 0.4
        self._shared = self._chance.random() < 0.25

    def _options(self) -> dict[str, Any]:
        widest = max(of.nbytes for fields in self._modes.values() for of in fields)
        size = (HEADER + self._capacity * widest + 0.5) * 1e-9
        return {"max_file_size": size, "durable": self._durable, "shared": self._shared}

    def _create(self) -> None:
        info = {"seed": self._chance.randint(0, 9)}
        self._model.now = _World({}, info)
        self._model.durable = self._durable
        writer = self._new_writer()
        self._told(f"{self._options()} {list(self._modes)}")
        self._writers[writer] = Dataset.create(self._folder, info=info, **self._options())
        self._model.made = True

    def _open(self) -> None:
        self._draw_options()
        self._model.durable = self._durable
        writer, session = self._new_writer(), self._chance.choice((None, None, "later"))
        self._told(f"{self._options()} session {session} by {writer}")
        dataset = Dataset.open(self._folder, writable=True, session=session, **self._options())
        self._writers[writer] = dataset
        self._collapse("before" if self._shared else 0)

    def _open_another(self) -> None:
        writer = self._new_writer()
        self._told(f"by {writer}")
        self._writers[writer] = Dataset.open(
            self._folder, writable=True, session="other", **self._options()
        )

    def _new_writer(self) -> int:
        self._next_writer += 1
        self._stage.actor = self._recorder.actor = self._next_writer
        return self._next_writer

    def _collapse(self, owner: Any) -> None:
        """From now on what is there is known, kept, and in one order."""
        self._model.also = ()
        self._model.keep_stored()
        self._model.keep_updates()
        seen = self._quiet_look()
        problem = self._model.promise("").broken(seen, power=False)
        if problem:
            raise Broken(problem)
        self._model.pin(seen)
        for name, mode in self._model.now.modes.items():
            mode.streams = {owner: _Stream(seen.rows(name).tolist(), sure=True)}
            mode.certain = True
        self._model.now.modes = {
            name: mode for name, mode in self._model.now.modes.items() if name in seen.fields
        }

    def _define(self) -> None:
        self._define_in(self._any()[1], self._chance.choice(list(self._modes)))

    def _define_in(self, dataset: Dataset, name: str) -> None:
        fields = self._modes[name]
        if name not in self._model.now.modes:
            self._model.now.modes[name] = _Mode(fields)
            if self._chance.random() < 0.3:
                fields = tuple(of if of.free_axis else replace(of, shape=None) for of in fields)
        self._told(f"defines {name}")
        dataset.define_fields(name, fields)
        self._model.now.modes[name].certain = True

    def _append(self) -> None:
        writer, dataset = self._any()
        name, most = self._chosen_mode(dataset), self._capacity * 5 // 2
        rows = self._model.new_rows(self._chance.randint(0, self._chance.choice((1, 4, most))))
        self._stream(name, writer).rows.extend(rows)
        self._told(f"{len(rows)} to {name} by {writer}")
        dataset.append(name, self._block(name, rows))
        self._model.now.modes[name].certain = True
        self._stored(name, writer)

    def _sample(self) -> None:
        writer, dataset = self._any()
        name = self._chosen_mode(dataset)
        rows = self._model.new_rows(self._chance.randint(1, 3))
        self._stream(name, writer).rows.extend(rows)
        self._told(f"{len(rows)} to {name} by {writer}")
        for row in rows:
            block = self._block(name, [row])
            dataset.append_sample(name, {field: values[0] for field, values in block.items()})
        self._model.now.modes[name].certain = True

    def _flush(self) -> None:
        writer, dataset = self._any()
        dataset.flush()
        self._model.store(writer)

    def _tick(self) -> None:
        self._sync()

    def _seal(self) -> None:
        for executor in self._stage.executors:
            executor.work()

    def _info(self) -> None:
        values = {self._chance.choice("ab"): self._chance.randint(0, 99)}
        self._all_or_nothing().info |= values
        self._told(str(values))
        self._any()[1].update_info(**values)
        self._done()

    def _update(self) -> None:
        _, dataset = self._any()
        dataset.flush()
        self._model.store()
        self._mark()
        modes = [n for n in self._model.now.modes if self._rows(n)]
        if not modes or self._model.updates + 1 >= VERSIONS:
            return
        name = self._chance.choice(modes)
        rows = self._rows(name)
        fields = self._chance.choice((self._modes[name], self._modes[name][:1]))
        names = [of.name for of in fields]
        how = self._chance.choice(("one", "slice", "some", "all"))
        if how == "one":
            index: Any = self._chance.randrange(len(rows))
        elif how == "some":
            places = self._chance.sample(range(len(rows)), self._chance.randint(1, len(rows)))
            index = np.array(sorted(places))
        else:
            start = 0 if how == "all" else self._chance.randrange(len(rows))
            stop = len(rows) if how == "all" else self._chance.randint(start, len(rows))
            index = slice(start, stop)
        chosen = np.array(rows)[index]
        touched = [int(chosen)] if how == "one" else chosen.tolist()
        version = self._model.begin_update(name, names, touched)
        self._told(f"{name} {names} {index} to version {version}")
        values = {of.name: encode(of, np.array(touched), version) for of in fields}
        if how == "one":
            values = {field: array[0] for field, array in values.items()}
        dataset.update(name, index, values)
        self._model.end_update(name, names, touched)

    def _remove(self) -> None:
        _, dataset = self._any()
        dataset.flush()
        self._model.store()
        self._mark()
        modes = [n for n in self._model.now.modes if self._rows(n)]
        if not modes:
            return
        name = self._chance.choice(modes)
        listed = dataset._manifest.modes[name].partitions
        which = self._chance.randrange(len(listed))
        chosen, start = listed[which], sum(p.rows for p in listed[:which])
        rows = self._rows(name)
        after = self._all_or_nothing()
        left = _Stream(rows[:start] + rows[start + chosen.rows :], sure=True)
        after.modes[name].streams = {0: left}
        self._told(f"partition {chosen.index} of {chosen.session} from {name}: {chosen.rows} rows")
        removed = dataset.remove_partition(name, chosen.index, chosen.session)
        if removed != chosen.rows:
            raise Broken(f"{removed} rows were removed, not {chosen.rows}")
        self._done()

    def _merge(self) -> None:
        writer, dataset = self._any()
        source = self._aside / f"source_{self._sources}"
        self._sources += 1
        dataset.flush()
        self._model.store(writer)
        added: dict[str, list[int]] = {}
        with self._unrecorded(), Dataset.create(source, **self._options()) as other:
            for name in self._modes:
                most = self._chance.choice((0, 3, self._capacity * 2))
                rows = added[name] = self._model.new_rows(self._chance.randint(0, most))
                other.define_fields(name, self._modes[name])
                other.append(name, self._block(name, rows))
        for name in added:
            self._model.now.modes.setdefault(name, _Mode(self._modes[name]))
        after = self._all_or_nothing()
        for name, rows in added.items():
            mode = after.modes[name]
            mode.certain = True
            if self._shared:
                mode.streams[f"merge {self._sources}"] = _Stream(rows, sure=True)
            else:
                stream = mode.streams.setdefault(0, _Stream([]))
                stream.rows.extend(rows)
            for owner, stream in mode.streams.items():
                if owner in (0, writer):
                    stream.kept = stream.stored = len(stream.rows)
        self._told(str({name: len(rows) for name, rows in added.items()}))
        dataset.merge(source)
        self._done()
        shutil.rmtree(source)

    def _normalize(self) -> None:
        name = self._chance.choice(list(self._modes))
        if self._rows(name):
            self._told(name)
            self._any()[1].recompute_normalization(name)
            self._model.store()

    def _look(self) -> None:
        """Compare what a writer reads with what is there."""
        writer, dataset = self._any()
        dataset.flush()
        self._model.store(writer)
        self._mark()
        if self._shared:
            dataset.refresh()
        problem = self._model.promise("").broken(read(dataset), power=False)
        if problem:
            raise Broken(f"the writer reads something else: {problem}")

    def _close(self) -> None:
        writer, dataset = self._any()
        del self._writers[writer]
        self._told(str(writer))
        dataset.close()
        self._closed(writer)

    def _abandon(self) -> None:
        """Let one of several writers die."""
        if len(self._writers) < 2:
            return
        writer, _ = self._any()
        self._told(str(writer))
        del self._writers[writer]
        self._stage.bury(writer)
        self._recorder.bury(writer)

    def _repair(self) -> None:
        self._told("")
        Dataset.repair(self._folder)
        self._collapse(0)

    def _rebuild(self) -> None:
        after = self._all_or_nothing()
        after.info = {}
        for mode in [*after.modes.values(), *self._model.now.modes.values()]:
            mode.certain = False  # those without rows are forgotten
        self._told("")
        Dataset.rebuild(self._folder)
        self._done()
        self._collapse(0)

    # Helping calls --------------------------------------------------------------------------

    def _any(self) -> tuple[int, Dataset]:
        writer = self._chance.choice(list(self._writers))
        self._stage.actor = self._recorder.actor = writer
        return writer, self._writers[writer]

    def _chosen_mode(self, dataset: Dataset) -> str:
        name = self._chance.choice(list(self._modes))
        is_free = any(of.free_axis for of in self._modes[name])  # no rows can tell that
        if (self._shared or is_free) and name not in dataset.modes:
            self._define_in(dataset, name)
        if name not in self._model.now.modes:  # the fields will be those of the rows
            fields = tuple(replace(of, unit="", role="training") for of in self._modes[name])
            self._modes[name] = fields
            self._model.now.modes[name] = _Mode(fields)
        return name

    def _stream(self, name: str, writer: int) -> _Stream:
        owner = writer if self._shared else 0
        return self._model.now.modes[name].streams.setdefault(owner, _Stream([]))

    def _rows(self, name: str) -> list[int]:
        """Return the rows of a mode that has one writer."""
        mode = self._model.now.modes.get(name)
        return [row for stream in mode.streams.values() for row in stream.rows] if mode else []

    def _block(self, name: str, rows: list[int]) -> Mapping[str, Any]:
        return {of.name: encode(of, np.array(rows, np.int64), 0) for of in self._modes[name]}

    def _stored(self, name: str, writer: int) -> None:
        stream = self._stream(name, writer)
        stream.stored = len(stream.rows)
        if self._durable:
            stream.kept = stream.stored

    def _all_or_nothing(self) -> _World:
        self._model.next = self._model.now.copy()
        return self._model.next

    def _done(self) -> None:
        assert self._model.next is not None
        self._model.now, self._model.next = self._model.next, None

    def _sync(self) -> None:
        """Let the syncers sync once: what was stored before is kept afterwards."""
        model = self._model
        owners = {syncer.actor for syncer in self._stage.syncers} & self._writers.keys()
        if not self._shared and owners:
            owners.add(0)
        before = [
            (stream, stream.stored)
            for mode in model.now.modes.values()
            for owner, stream in mode.streams.items()
            if owner in owners
        ]
        updates = {key: limits.stored for key, limits in model.versions.items() if 0 in owners}
        for syncer in self._stage.syncers:
            syncer.sync()
        for stream, count in before:
            stream.kept = max(stream.kept, count)
        for key, stored in updates.items():
            limits = model.versions[key]
            if len(stored) == len(limits.kept):
                kept = np.maximum(limits.kept, stored)
                model.versions[key] = Versions(kept, limits.stored, limits.newest)
        self._mark()

    def _closed(self, writer: int) -> None:
        model = self._model
        if self._shared:
            for mode in model.now.modes.values():
                for owner, stream in mode.streams.items():
                    if owner in (0, writer):
                        stream.kept = stream.stored = len(stream.rows)
        else:
            model.keep()
            model.keep_updates()

    def _die(self) -> None:
        """The process is killed: see what is left, as the next process does."""
        self._leave()
        self._fuse = -1
        if not self._model.made:
            return
        promise = self._model.promise(self._calling)
        seen = self._quiet_look()
        problem = promise.broken(seen, power=False)
        if problem:
            self.problems.append(f"after a kill in {self._calling}: {problem}")
            return
        self._model.adopt(seen, promise, power=False)

    def _leave(self) -> None:
        self._writers.clear()
        self._stage.bury()
        self._recorder.bury()

    def _quiet_look(self) -> Seen:
        with self._unrecorded():
            return look(self._folder)

    @contextlib.contextmanager
    def _unrecorded(self) -> Iterator[None]:
        """Do something that is not part of the history."""
        stage = Stage()
        stage.boot = self._stage.boot
        with stage.entered(), stage.recorded(os):
            yield


_CALLS = (
    "append", "sample", "flush", "tick", "seal", "info", "update", "remove", "merge", "normalize",
    "look", "close", "define", "abandon",
)  # fmt: skip
_WEIGHTS = (10, 4, 2, 5, 4, 1, 5, 1.5, 1.5, 1, 1, 2, 1, 0.5)
