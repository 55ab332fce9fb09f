"""Stripes: rows that several processes write in turn, in random histories against lists in memory.

Every row has a number of its own, from which its values are made. The writers are in this process:
one that is killed has its files closed, and nothing else.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from contextlib import suppress
from io import FileIO
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sizes import trials

from physx_core import Dataset, Field
from physx_core.dataset.read import reader as reading
from physx_core.dataset.read import shuffling
from physx_core.dataset.read.access import disk
from physx_core.dataset.repair.report import find_problems
from physx_core.dataset.store import locks, manifest_file
from physx_core.dataset.store.manifest import whole_stripes
from physx_core.dataset.store.partition import commits
from physx_core.dataset.store.partition import format as partition_format
from physx_core.dataset.store.partition.format import inspect, inspect_open
from physx_core.dataset.store.partition.spans import FlatIndex, Span
from physx_core.dataset.write.stripe_writer import StripeWriter
from physx_core.errors import DatasetError

pytestmark = pytest.mark.processes

FIELDS = [Field("n", (), "int64"), Field("x", (3,), unit="m"), Field("f", (), "bool")]
QUICK = settings(database=None, deadline=None, max_examples=trials(4, 2), stateful_step_count=30)
LONG = settings(QUICK, max_examples=trials(5, 2), stateful_step_count=50)
SYNCED = {}  # by a file's inode: see `sync`


def sync(descriptor):
    """Note what a sync would bring to the disk: the rows, and those of the marks, of a file."""
    with suppress(OSError, DatasetError):  # a folder, or not a partition
        found = inspect_open(FileIO(descriptor, closefd=False), Path("synced"))
        marked = max((mark.rows for mark in found.commits[1:]), default=0)
        SYNCED[os.fstat(descriptor).st_ino] = found.rows, marked


def synced(path):
    """Return how many rows of a file a sync has brought to the disk, and how many with a mark."""
    return SYNCED[path.stat().st_ino]


@pytest.fixture(autouse=True)
def little_at_a_time(monkeypatch):
    """A few rows fill blocks and windows, and a few partitions all files that may be open."""
    monkeypatch.setattr(reading, "rows_per_block", lambda nbytes: max(1, 200 // max(1, nbytes)))
    monkeypatch.setattr(disk, "_OPEN_FILES", 3)
    monkeypatch.setattr(shuffling, "_CHUNK", 200)
    monkeypatch.setattr(shuffling, "_BLOCK", 200)
    monkeypatch.setattr(shuffling, "_WINDOW", 3)
    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, sync)
    SYNCED.clear()


def values(numbers):
    numbers = np.asarray(numbers, np.int64)
    x = numbers[:, None] + np.array([0.0, 0.25, 0.5])
    return {"n": numbers, "x": x, "f": numbers % 3 == 0}


def size(capacity):
    """`max_file_size` of partitions of so many rows."""
    return (2**14 + 24 * capacity + 0.5) * 1e-9


def interleaved(parts):
    """The rows of partitions that take turns, up to the first that is missing."""
    found = []
    for place in range(max(map(len, parts), default=0)):
        for part in parts:
            if place >= len(part):
                return found
            found.append(part[place])
    return found


def check(dataset, numbers):
    """All ways to read give these rows."""
    assert dataset.num_samples("training") == len(numbers)
    if not numbers:
        return
    wanted, view = values(numbers), dataset["training"]
    for name, rows in wanted.items():
        np.testing.assert_array_equal(view[name][:], rows)
    order = np.random.default_rng(len(numbers)).permutation(len(numbers))
    np.testing.assert_array_equal(view["x"][order], wanted["x"][order])
    np.testing.assert_array_equal(view["n"][1::3], wanted["n"][1::3])
    middle = slice(len(numbers) // 3, len(numbers) // 3 * 2 + 1)
    np.testing.assert_array_equal(view["x"][middle], wanted["x"][middle])
    for order in ("exact", "blocks"):
        for shuffle in (False, True):
            options = {"shuffle": shuffle, "seed": 0, "order": order}
            batches = [
                {name: rows.copy() for name, rows in batch.items()}
                for batch in dataset.batches("training", 4, **options)
            ]
            found = np.concatenate([batch["n"] for batch in batches])
            assert sorted(found) == sorted(numbers) and (shuffle or list(found) == numbers)
            x = np.concatenate([batch["x"] for batch in batches])
            np.testing.assert_array_equal(x, values(found)["x"])
    mean = dataset.normalization["x"].mean
    np.testing.assert_allclose(mean, wanted["x"].mean(axis=0), rtol=1e-12)
    assert dataset.verify() == []


class Machine(RuleBasedStateMachine):
    """One dataset, whose rows come from its own writer and from runs of several others."""

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=Path.cwd()))
        self.folder, self.copies = self.root / "data", 0
        self.groups = []  # of partitions, as lists of numbers, by the partition's index
        self.dataset, self.stripes, self.writers, self.made = None, None, [], []
        self.next_number = self.committed = 0

    def teardown(self):
        for writer in self.writers:
            writer.close()
        if self.dataset is not None:
            self.dataset.close()
        shutil.rmtree(self.root)

    @property
    def numbers(self):
        """The rows that were there before the run."""
        return [n for group in self.groups for n in interleaved(list(group.values()))]

    @property
    def run_rows(self):
        """The rows of the run that are in its files, up to the first that is missing."""
        count = len(self.made)
        total = min(made * count + place for place, made in enumerate(self.made))
        return list(range(self.first, self.first + total))

    idle = precondition(lambda self: self.stripes is None)
    running = precondition(lambda self: self.stripes is not None)

    def opened(self, capacity):
        if self.folder.exists():
            return Dataset.open(self.folder, writable=True, max_file_size=size(capacity))
        return Dataset.create(self.folder, max_file_size=size(capacity))

    # Between runs -----------------------------------------------------------------------------

    @idle
    @rule(capacity=st.integers(1, 4), count=st.integers(1, 9))
    def append(self, capacity, count):
        numbers = list(range(self.next_number, self.next_number + count))
        self.next_number += count
        with self.opened(capacity) as dataset:
            dataset.define_fields("training", FIELDS)
            dataset.append("training", values(numbers))
        plain = self.listed()[-math.ceil(count / capacity) :]
        for place, entry in enumerate(plain):
            self.groups.append({entry["index"]: numbers[place * capacity :][:capacity]})

    @idle
    @precondition(lambda self: self.groups)
    @rule(which=st.integers(0, 50))
    def remove_partition(self, which):
        listed = [(group, index) for group in self.groups for index in group]
        group, index = listed[which % len(listed)]
        with self.opened(3) as dataset:
            assert dataset.remove_partition("training", index) == len(group.pop(index))
        self.groups = [group for group in self.groups if group]

    @idle
    @precondition(lambda self: self.numbers)
    @rule(which=st.integers(0, 50), count=st.integers(1, 9))
    def update(self, which, count):
        index = sorted({(which + 7 * step) % len(self.numbers) for step in range(count)})
        with self.opened(3) as dataset:
            kept = {name: view[index] for name, view in dataset["training"].items()}
            dataset.update("training", index, values(np.arange(-len(index), 0)))
            np.testing.assert_array_equal(
                dataset["training"]["n"][index], np.arange(-len(index), 0)
            )
            dataset.update("training", index, kept)

    @idle
    @precondition(lambda self: self.numbers)
    @rule(capacity=st.integers(1, 4))
    def merge(self, capacity):
        """Into a dataset that has rows; which then is the dataset."""
        other = self.root / f"merged-{self.next_number}"
        first, self.next_number = self.next_number, self.next_number + 2
        with Dataset.create(other, max_file_size=size(capacity)) as dataset:
            dataset.define_fields("training", FIELDS)
            dataset.append("training", values([first, first + 1]))
            dataset.merge(self.folder)
        shutil.rmtree(self.folder)
        other.rename(self.folder)
        own = math.ceil(2 / capacity)
        indices = iter([entry["index"] for entry in self.listed()])
        groups = [{next(indices): [first + k]} for k in range(2)] if own == 2 else []
        groups = groups or [{next(indices): [first, first + 1]}]
        self.groups = groups + [
            {next(indices): part for part in group.values()} for group in self.groups
        ]

    @idle
    @precondition(lambda self: self.numbers)
    @rule()
    def rebuild(self):
        Dataset.rebuild(self.folder)

    def listed(self):
        return json.loads((self.folder / "dataset.json").read_text())["modes"]["training"][
            "partitions"
        ]

    # Runs -------------------------------------------------------------------------------------

    @idle
    @rule(count=st.integers(1, 4), capacity=st.integers(1, 4))
    def begin(self, count, capacity):
        self.dataset = self.opened(capacity)
        self.stripes = self.dataset.stripes("training", count)
        self.stripes.define(FIELDS)
        assert self.stripes.capacity == capacity
        self.capacity, self.first = capacity, self.next_number
        self.next_number += 100_000
        self.made, self.indices, self.committed = [0] * count, [], 0
        self.writers = [StripeWriter(self.folder, FIELDS, capacity) for _ in range(count)]

    @running
    @rule(place=st.integers(0, 3), count=st.integers(1, 9), tells=st.booleans())
    def write(self, place, count, tells):
        place %= len(self.made)
        writer, made = self.writers[place], self.made[place]
        while self.stripes.begun * self.capacity < made + count:
            number = self.stripes.begun
            self.stripes.begin()
            entries = [self.stripes.entries(p)[number] for p in range(len(self.made))]
            self.indices.append([entry.index for entry in entries])
            for each, entry in zip(self.writers, entries, strict=True):
                each.add(number, entry)
        rows = [self.first + (made + k) * len(self.made) + place for k in range(count)]
        writer.append(values(rows), count)
        self.made[place] += count
        assert writer.rows == self.made[place]
        if tells:
            self.stripes.note(place, writer.rows)
            self.accept(place, writer.take_sealed(wait=True))

    @running
    @rule()
    def commit(self):
        self.committed = max(self.committed, self.stripes.whole)
        self.stripes.commit(self.committed)

    @running
    @rule(place=st.integers(0, 3))
    def kill_writer(self, place):
        """Another one continues with the rows that are there, whether they were told or not."""
        place %= len(self.made)
        told = self.stripes._written[place]
        abandon(self.writers[place])
        writer = StripeWriter(self.folder, FIELDS, self.capacity)
        for number, entry in self.stripes.entries(place).items():
            writer.add(number, entry)
        assert writer.resume(told) == self.made[place]
        self.writers[place] = writer

    @running
    @rule(place=st.integers(0, 3))
    def lose_rows_of_a_machine(self, place):
        """Rows that were told, but not synced, are gone with a writer's machine."""
        place %= len(self.made)
        told = self.made[place]
        self.stripes.note(place, told)
        entries = self.stripes.entries(place)
        number = (told - 1) // self.capacity
        if not told or number not in entries:
            return
        abandon(self.writers[place])
        path = self.folder / entries[number].file_name("x")
        found = inspect(path)
        if found.commits[0].base == found.commits[0].rows:
            return  # it has been sealed: it is on the disk
        with path.open("r+b") as file:
            file.seek(found.data_offset)
            file.write(bytes(found.rows * 24))
        writer = StripeWriter(self.folder, FIELDS, self.capacity)
        for each, entry in entries.items():
            writer.add(each, entry)
        have = writer.resume(told)
        assert have <= told and (have == told or not have % self.capacity)
        rows = [self.first + k * len(self.made) + place for k in range(have, told)]
        if rows:
            writer.append(values(rows), len(rows))
        self.writers[place], self.made[place] = writer, told

    @running
    @rule(orderly=st.booleans())
    def end(self, orderly):
        for place, writer in enumerate(self.writers):
            self.stripes.note(place, writer.rows)
            self.accept(place, writer.take_sealed(wait=True))
        rows = self.run_rows
        for place, writer in enumerate(self.writers):
            if orderly:
                share = len(rows[place :: len(self.made)])
                self.accept(place, writer.finish(share))
            writer.close()
        self.dataset.close()
        self.keep(rows)
        assert not (self.folder / "dataset.clients").exists()

    @running
    @rule()
    def kill_all(self):
        folder = self.copy()
        for writer in self.writers:
            abandon(writer)
        self.dataset.close()
        shutil.rmtree(self.folder)
        folder.rename(self.folder)
        rows = self.run_rows
        with self.opened(2) as dataset:
            check(dataset, self.numbers + rows)
        self.keep(rows)

    @running
    @rule()
    def look(self):
        """Whoever opens the folder sees what is in the files; so do those who repair it."""
        wanted = self.numbers + self.run_rows
        with Dataset.open(self.folder) as dataset:
            if "training" in dataset:
                check(dataset, wanted)
        folder = self.copy()
        assert not [text for text in Dataset.repair(folder) if "damaged" in text]
        with Dataset.open(folder) as dataset:
            check(dataset, wanted)
        folder = self.copy()
        (folder / "dataset.json").unlink()
        if list(folder.glob("*_training_*.h5")):
            with Dataset.open(folder, writable=True) as dataset:
                check(dataset, wanted)

    @running
    @rule(place=st.integers(0, 3), field=st.sampled_from(["n", "x", "f"]), torn=st.integers(1, 9))
    def cut_power(self, place, field, torn):
        """Rows that no sync has brought to the disk are lost; no gap and no other value shows."""
        if self.stripes.begun:
            self.rows_after_power_cut(place % len(self.made), field, torn)

    @invariant()
    def reads(self):
        if self.stripes is not None:
            check(self.dataset, self.numbers + self.run_rows[: self.committed])
        elif self.folder.exists():
            with Dataset.open(self.folder) as dataset:
                check(dataset, self.numbers)
            entries = self.listed()
            if self.numbers and "stripe" in str(entries):
                with h5py.File(self.folder / f"{entries[-1]['session']}.h5") as virtual:
                    found = virtual["training"]["n"][:].tolist()
                assert found == self.numbers

    # --------------------------------------------------------------------------------------------

    def rows_after_power_cut(self, place, field, torn):
        """Spoil up to `torn` rows that are not on the disk; return how many rows the run keeps."""
        number = self.stripes.begun - 1
        name = f"{self.stripes.session}_training_{field}_{self.indices[number][place]}.h5"
        # Other threads sync: what was marked before the copy is in it, and a row that was not
        # synced after it was not before.
        _, marked = synced(self.folder / name)
        folder = self.copy()
        path = folder / name
        found = inspect(path)
        on_disk, _ = synced(self.folder / name)
        size_of = found.identity.field.nbytes
        lost = max(0, min(torn, found.rows - on_disk))
        made = list(self.made)
        if lost:
            made[place] = number * self.capacity + marked
        least = len(self.numbers) + whole_stripes(made)
        content = bytearray(path.read_bytes())
        begin = found.data_offset + (found.rows - lost) * size_of
        end = found.data_offset + found.rows * size_of
        content[begin:end] = bytes(b ^ 0x5A for b in content[begin:end])
        path.write_bytes(content)
        with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for module in (commits, partition_format):
                patch.setattr(module, "boot_id", lambda: "another")
            with Dataset.open(folder) as dataset:
                if "training" not in dataset:
                    return 0
                count = dataset.num_samples("training")
                have = dataset["training"]["n"][:].tolist() if count else []
            wanted = self.numbers + self.run_rows
            assert have == wanted[:count] and count >= least
            with Dataset.open(folder, writable=True) as dataset:
                assert dataset.num_samples("training") == count
            with Dataset.open(folder) as dataset:
                check(dataset, wanted[:count])
        return count - len(self.numbers)

    def accept(self, place, sealed):
        for number, entry in sealed:
            running = {"x": entry.running["x"]}
            assert self.stripes.accept(place, number, entry.rows, entry.checksums, running)

    def keep(self, rows):
        """Add what the run left to the model."""
        count = len(self.made)
        for number, indices in enumerate(self.indices):
            here = rows[number * self.capacity * count :][: self.capacity * count]
            parts = {index: here[place::count] for place, index in enumerate(indices)}
            if here:
                self.groups.append({index: part for index, part in parts.items() if part})
        self.dataset = self.stripes = None
        self.writers = []

    def copy(self):
        self.copies += 1
        return Path(shutil.copytree(self.folder, self.root / f"copy-{self.copies}"))


def abandon(writer):
    """Have a writer end as if its process were killed."""
    writer._sealer.close()
    opened, writer._opened = writer._opened, None
    if opened is not None:
        for file in opened.files.values():
            file.close()
    writer._digester.close()
    writer._syncer._partitions.clear()  # it does not sync any more
    writer._syncer._paths.clear()
    writer._syncer._helper.close()


def test_stripes_behave_like_lists():
    run_state_machine_as_test(Machine, settings=QUICK)


@pytest.mark.faults
def test_stripes_behave_like_lists_in_long_histories():
    run_state_machine_as_test(Machine, settings=LONG)


def test_rows_found_by_restarted_stripe_writer_survive_power_cut():
    """A restart syncs them; only what was written since is not on the disk yet."""
    machine = Machine()
    try:
        machine.begin(count=1, capacity=4)
        for count in (1, 6, 6):
            machine.write(place=0, count=count, tells=count > 1)
        machine.kill_writer(place=0)
        for more in (0, 2):
            if more:
                machine.write(place=0, count=more, tells=False)
            for field in ("n", "x", "f"):
                for torn in (1, 2, 9):
                    assert 13 <= machine.rows_after_power_cut(0, field, torn) <= 13 + more
        machine.reads()
    finally:
        machine.teardown()


# Details ----------------------------------------------------------------------------------------


def test_the_flat_index_finds_what_the_spans_say():
    spans = [
        Span(0, 3),
        Span(3, 3, 3, 0),
        Span(4, 2, 3, 1),
        Span(5, 2, 3, 2),
        Span(10, 0),
        Span(10, 2),
    ]
    index = FlatIndex(spans)
    wanted = {
        span.start + k * span.stride: (number, k)
        for number, span in enumerate(spans)
        for k in range(span.rows)
    }
    assert sorted(wanted) == list(range(12))
    found = zip(*index.locate(np.arange(12)), strict=True)
    assert {row: tuple(map(int, place)) for row, place in enumerate(found)} == wanted
    assert {row: index.find(row)[:2] for row in range(12)} == wanted
    for start in range(12):
        for stop in range(start, 13):
            rows = [None] * (stop - start)
            for number, span in enumerate(spans):
                first, count = span.inside(start, stop)
                if count:
                    rows[span.among(first, count, start)] = [
                        (number, first + k) for k in range(count)
                    ]
            assert rows == [wanted[row] for row in range(start, stop)]


def test_stripe_lock_allows_one_writer(folder, monkeypatch):
    """A process that is alive keeps its stripe; at its end the next one gets it at once."""
    monkeypatch.setattr(locks, "_PATIENCE", 0.1)
    with Dataset.create(folder) as dataset:
        dataset.stripes("training", 2)
        proof = folder / "dataset.clients"
        holder = (
            "import sys; from pathlib import Path; from physx_core.dataset.store import locks; "
            "locks.take_over(Path(sys.argv[1]), 1); print('holds', flush=True); sys.stdin.read()"
        )
        process = subprocess.Popen(
            [sys.executable, "-c", holder, str(proof)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout.readline() == "holds\n"
        os.close(locks.take_over(proof, 0))
        with pytest.raises(DatasetError, match="still writing the rows of instance 2"):
            locks.take_over(proof, 1)
        process.kill()
        process.communicate()
        os.close(locks.take_over(proof, 1))


def test_manifests_with_impossible_stripes_are_refused(folder):
    with Dataset.create(folder, max_file_size=size(2)) as dataset:
        stripes = dataset.stripes("training", 3)
        stripes.define(FIELDS)
        stripes.begin()
        for place in range(3):
            with StripeWriter(folder, FIELDS, 2) as writer:
                writer.add(0, stripes.entries(place)[0])
                writer.append(values([place, place + 3]), 2)
            stripes.note(place, 2)
    path = folder / "dataset.json"
    text = path.read_text()
    plain = json.loads(text)
    assert plain["format_version"] == 2
    wrong = [
        (2, {"stripe": [2, 4]}, "are inconsistent"),
        (1, {"stripe": [0, 3], "first_row": 0}, "are inconsistent"),
        (0, {"stripe": [3, 3]}, "place of a stripe"),
        (0, {"stripe": [0, 1]}, "number of stripes"),
        (1, {"stripe": 7}, "a stripe cannot be 7"),
        (2, {"rows": 0}, "inconsistent numbers of rows"),
        (0, {"rows": 1}, "inconsistent numbers of rows"),
        (1, {"sealed": False}, "some stripes"),
    ]
    for place, changes, problem in wrong:
        changed = json.loads(text)
        changed["modes"]["training"]["partitions"][place] |= changes
        path.write_text(json.dumps(changed))
        with pytest.raises(DatasetError, match=problem):
            manifest_file.load(folder, edited=True)
    changed = json.loads(text)
    changed["modes"]["training"]["partitions"][0]["stripe"] = [1, 3]
    path.write_text(json.dumps(changed))
    found = find_problems(folder, manifest_file.load(folder, edited=True))
    assert all("has a different stripe" in problem for problem in found) and len(found) == 3
    path.write_text(text)
    with Dataset.open(folder) as dataset:
        check(dataset, list(range(6)))
