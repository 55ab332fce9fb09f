"""Random histories of calls, each compared with the simplest possible model: lists in memory.

Every value that is written is made from a number of its own, so that any mix-up shows.
"""

import contextlib
import itertools
import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from sizes import trials

from physx_core import Dataset, Field, View
from physx_core.dataset.read import reader as reading
from physx_core.dataset.read import shuffling
from physx_core.dataset.read.access import disk, memory
from physx_core.dataset.store.partition import segment
from physx_core.errors import (
    ConfigError,
    DatasetError,
    DatasetLockedError,
    DatasetNotFoundError,
    FieldShapeError,
    FieldsMismatchError,
    FieldTypeError,
    MissingFieldError,
    NotFiniteError,
    UnknownFieldError,
    UsageError,
)

QUICK = settings(database=None, max_examples=2, stateful_step_count=30)  # one is trivial
LONG = settings(QUICK, stateful_step_count=50)


@pytest.fixture(autouse=True)
def little_at_a_time(monkeypatch):
    """A few rows fill blocks and windows, and a few partitions all files that may be open."""
    for module in (reading, segment):
        monkeypatch.setattr(module, "rows_per_block", lambda nbytes: max(1, 400 // max(1, nbytes)))
    monkeypatch.setattr(disk, "_OPEN_FILES", 2)
    monkeypatch.setattr(shuffling, "_CHUNK", 200)
    monkeypatch.setattr(shuffling, "_BLOCK", 200)
    monkeypatch.setattr(shuffling, "_WINDOW", 3)
    monkeypatch.setattr(shuffling, "_MOST_SORTED", 40)
    monkeypatch.setattr(shuffling, "_SLAB", 16)
    for name in ("fsync", "fdatasync"):  # nothing here depends on what has reached the disk
        monkeypatch.setattr(os, name, lambda descriptor: None)


# The model --------------------------------------------------------------------------------------

NUMBER = Field("n", (), "int64")
OTHERS = [
    Field("x", (3,), unit="m"),
    Field("f", (), "float32", role="additional"),
    Field("u", (), "uint16"),
    Field("flag", (), "bool"),
    Field("none", (0, 2)),
    Field("large", (600,)),
]
TRAJECTORY = [
    Field("env_id", (), "int32", role="additional"),
    Field("episode", (), "int64", role="additional"),
    Field("step", (), "int64", role="additional"),
    Field("f", (), "float32"),
]


def values(field, numbers):
    """The values of a field that are made from numbers, one for each row."""
    numbers = np.asarray(numbers, np.int64)
    numbers = {
        "env_id": 1 + numbers % 2,
        "episode": numbers // 12,
        "step": numbers // 2 % 6,
    }.get(field.name, numbers)
    width = int(np.prod(field.shape))
    rows = numbers[:, None] + np.linspace(0, 0.5, max(1, width))[:width]
    kind = np.dtype(field.dtype)
    if kind.kind != "f":
        rows = (numbers % (2 if kind.kind == "b" else np.iinfo(kind).max))[:, None]
    return rows.astype(kind).reshape(len(numbers), *field.shape)


@dataclass
class Part:
    """A partition: who wrote it, and how many rows it has."""

    session: str
    index: int
    rows: int = 0


@dataclass
class Mode:
    """What a mode holds: for each field, the numbers that its rows are made from."""

    fields: dict
    numbers: dict = field(init=False)
    parts: list = field(default_factory=list)
    open: bool = False  # whether the last partition takes more rows
    pending: list = field(default_factory=list)
    removed: dict = field(default_factory=dict)  # largest number of a removed partition

    def __post_init__(self):
        self.numbers = {name: np.zeros(0, np.int64) for name in self.fields}

    @property
    def rows(self):
        return len(self.numbers["n"])

    def add(self, numbers):
        for name in self.fields:
            self.numbers[name] = np.concatenate([self.numbers[name], numbers])

    def append(self, numbers, session, capacity):
        self.add(numbers)
        left = len(numbers)
        while left:
            if not self.open or self.parts[-1].rows == capacity:
                self.parts.append(Part(session, self.next_index(session)))
                self.open = True
            count = min(left, capacity - self.parts[-1].rows)
            self.parts[-1].rows += count
            left -= count

    def next_index(self, session):
        used = [part.index for part in self.parts if part.session == session]
        return 1 + max([*used, self.removed.get(session, -1)])

    def snapshot(self):
        return {name: numbers.copy() for name, numbers in self.numbers.items()}

    def values(self, name, rows=slice(None)):
        return values(self.fields[name], self.numbers[name][rows])


def same(found, field, numbers):
    expected = values(field, numbers)
    assert found.dtype == expected.dtype and found.shape == expected.shape
    np.testing.assert_array_equal(found, expected)


def one_of(found, field, several, dtype=None):
    """Each row has its value of one of several times."""
    fits = np.zeros(len(found), bool)
    for numbers in several:
        expected = values(field, numbers).astype(dtype or field.dtype)
        fits |= (found == expected).all(axis=tuple(range(1, found.ndim)))
    assert fits.all(), (field.name, found[~fits], [values(field, n)[~fits] for n in several])


def size(nbytes):
    """`max_file_size` with room for so many bytes of rows."""
    return (2**14 + nbytes + 0.5) * 1e-9


def stored(fields, numbers):
    return {name: values(each, numbers) for name, each in fields.items()}


def check_statistics(found, mode):
    floating = [
        name for name, each in mode.fields.items() if np.dtype(each.dtype).kind == "f" and mode.rows
    ]
    assert list(found) == floating
    for name in floating:
        rows = mode.values(name).astype("float64")
        assert found[name].mean.shape == found[name].std.shape == rows.shape[1:]
        np.testing.assert_allclose(found[name].mean, rows.mean(axis=0), rtol=1e-9)
        deviation = rows.std(axis=0)
        deviation = np.where(deviation > 1e-9, deviation, 1)
        np.testing.assert_allclose(found[name].std, deviation, rtol=1e-7)
        np.testing.assert_array_equal(found[name].minimum, rows.min(axis=0))
        np.testing.assert_array_equal(found[name].maximum, rows.max(axis=0))


def episodes_of(mode):
    """Trajectories in plain Python: rows of an instance with one number and steps in sequence."""
    columns = [mode.values(name).tolist() for name in ("env_id", "episode", "step")]
    found, last = [], {}
    for row, (env_id, episode, step) in enumerate(zip(*columns, strict=True)):
        before = last.get(env_id)
        if before is None or before[1:] != (episode, step - 1):
            before = ([],)
            found.append((env_id, episode, before[0]))
        before[0].append(row)
        last[env_id] = (before[0], episode, step)
    return found


# Strategies -------------------------------------------------------------------------------------

MODES = st.sampled_from(["training", "training", "validation"])
KNOWN = st.integers(0, 2)
COUNTS = st.integers(0, 24)
NUMBERS = st.integers(-300, 300)
PLACES = st.none() | st.integers(-70, 70)
INDEXES = st.one_of(
    st.tuples(st.just("slice"), PLACES, PLACES, st.sampled_from([None, 1, 2, 5, -1, -3])),
    st.tuples(st.just("number"), NUMBERS),
    st.tuples(
        st.just("array"),
        st.lists(NUMBERS, max_size=12),
        st.sampled_from(["int64", "uint64", "int8", "uint8", "int16"]),
    ),
    st.tuples(st.just("list"), st.lists(NUMBERS, max_size=12)),
    st.tuples(st.just("mask"), st.integers(1, 4)),
)
BYTES = st.sampled_from([1, 100, 200, 300, 600, 2000])  # rows of a partition, about
SELDOM = precondition(lambda self: self.turn % 3 == 0)
HOW = st.sampled_from([None, "exact", "blocks"])


def index_of(drawn, total):
    """What to index rows with: valid, whatever their number is, unless there are none."""
    kind, *drawn = drawn
    if kind == "slice":
        return slice(*drawn)
    if kind == "mask":
        return np.arange(total) % 4 < drawn[0]
    dtype = drawn[1] if kind == "array" else "int64"
    limits = np.iinfo(dtype)
    lowest, highest = max(-total, int(limits.min)), min(total - 1, int(limits.max))
    numbers = np.atleast_1d(drawn[0]) if total else []
    fitted = [int(lowest + number % (highest - lowest + 1)) for number in numbers]
    if kind == "number":
        return fitted[0] if fitted else 0
    return np.array(fitted, dtype) if kind == "array" else fitted


@dataclass
class Iteration:
    """Batches that are being read, and what they may hold."""

    batches: object
    mode: str
    fields: list
    dtype: object
    size: int
    order: np.ndarray
    states: list
    more: int = 0
    done: int = 0


class Machine(RuleBasedStateMachine):
    """A dataset with one writer, and a reader beside it."""

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=Path.cwd()))
        self.folder = self.root / "data"
        self.dataset = self.reader = None
        self.modes, self.views = {}, {}
        self.iterations = []
        self.next_number, self.others, self.turn = 0, 0, 0

    def teardown(self):
        for dataset in (self.reader, self.dataset):
            if dataset is not None:
                with contextlib.suppress(Exception):  # it would hide what failed before
                    dataset.close()
        shutil.rmtree(self.root)

    def draw(self, count):
        """Numbers that were never used before."""
        first, self.next_number = self.next_number, self.next_number + count
        return np.arange(first, self.next_number)

    @initialize(
        nbytes=BYTES,
        durable=st.booleans(),
        others=st.lists(st.sampled_from(OTHERS), max_size=3, unique=True),
        count=st.integers(0, 30),
        defined=st.booleans(),
    )
    def create(self, nbytes, durable, others, count, defined):
        self.nbytes, self.session, self.info = nbytes, "run", {"a": 1}
        self.others_of = {"training": [NUMBER, *others], "validation": [NUMBER, *TRAJECTORY]}
        self.dataset = Dataset.create(
            self.folder, max_file_size=size(nbytes), durable=durable, info=self.info
        )
        if defined:
            self.define_fields("training", shapes=True)
        self.append("training", count, "array")

    def known(self, number):
        """One of the modes that there are; the first one is likelier."""
        return [*self.modes, next(iter(self.modes))][number % (len(self.modes) + 1)]

    # Writing ------------------------------------------------------------------------------------

    def capacity(self, mode):
        largest = max(field.nbytes for field in self.modes[mode].fields.values())
        return max(1, self.nbytes // largest)

    def fields_of(self, mode):
        known = self.modes.get(mode)
        return known.fields if known else {each.name: each for each in self.others_of[mode]}

    def committed(self, *modes):
        """Pending samples of modes, or of all, have been committed."""
        for name in modes or self.modes:
            mode = self.modes[name]
            if mode.pending:
                mode.append(np.array(mode.pending), self.session, self.capacity(name))
                mode.pending.clear()

    def defined(self, mode, inferred):
        if mode not in self.modes:
            fields = self.others_of[mode]
            if inferred:
                fields = [
                    Field(
                        each.name,
                        each.shape,
                        each.dtype,
                        role="additional"
                        if each.name in ("env_id", "episode", "step")
                        else "training",
                    )
                    for each in fields
                ]
            self.modes[mode] = Mode({each.name: each for each in fields})
            self.views[mode] = None

    @SELDOM
    @rule(mode=MODES, shapes=st.booleans())
    def define_fields(self, mode, shapes):
        fields = list(self.fields_of(mode).values())
        given = [
            Field(each.name, each.shape if shapes else None, each.dtype, each.unit, each.role)
            for each in fields
        ]
        if mode not in self.modes and not shapes:
            return  # `append` is told the shapes by its rows; see `test_defined_fields`
        self.dataset.define_fields(mode, given)
        self.defined(mode, False)

    @rule(mode=MODES, count=COUNTS, form=st.sampled_from(["array", "list", "strided", "swapped"]))
    def append(self, mode, count, form):
        fields = self.fields_of(mode)
        largest = max(each.nbytes for each in fields.values())
        count = min(count, 2 * max(1, self.nbytes // largest) + 1)
        numbers = self.draw(count)
        rows = stored(fields, numbers)
        if form == "strided":
            rows = {name: np.repeat(block, 2, axis=0)[::2] for name, block in rows.items()}
        elif form == "swapped":
            rows = {name: block.astype(block.dtype.newbyteorder()) for name, block in rows.items()}
        elif form == "list" and count and mode in self.modes and "none" not in fields:
            rows = {name: block.tolist() for name, block in rows.items()}
        self.dataset.append(mode, rows)
        self.defined(mode, True)
        self.committed(mode)
        self.modes[mode].append(numbers, self.session, self.capacity(mode))

    @rule(mode=MODES, count=st.integers(1, 5))
    def append_samples(self, mode, count):
        fields = self.fields_of(mode)
        for number in self.draw(count):
            sample = {name: block[0] for name, block in stored(fields, [number]).items()}
            self.dataset.append_sample(mode, sample)
            self.defined(mode, True)
            self.modes[mode].pending.append(number)

    @rule(mode=MODES, counts=st.lists(COUNTS, min_size=2, max_size=4))
    def append_blocks(self, mode, counts):
        for count in counts:
            self.append(mode, count, "array")

    @rule(info=st.none() | st.dictionaries(st.sampled_from(["a", "b"]), st.integers()))
    def flush(self, info):
        if info is None:
            self.dataset.flush()
            self.committed()
        else:
            self.dataset.update_info(**info)
            self.info |= info

    @rule(mode=KNOWN, index=INDEXES, chosen=st.integers(1, 2**7))
    def update(self, mode, index, chosen):
        mode = self.known(mode)
        self.committed()
        model = self.modes[mode]
        index = index_of(index, model.rows)
        if isinstance(index, int) and not model.rows:
            return
        numbers = self.draw(len(np.atleast_1d(np.arange(model.rows)[index])))
        names = [name for k, name in enumerate(model.fields) if chosen >> k & 1] or ["n"]
        rows = {name: values(model.fields[name], numbers) for name in names}
        if isinstance(index, int):
            rows = {name: block[0] for name, block in rows.items()}
        self.dataset.update(mode, index, rows)
        for name in names:
            for row, number in zip(
                np.atleast_1d(np.arange(model.rows)[index]), numbers, strict=True
            ):
                model.numbers[name][row] = number
        for iteration in self.iterations:
            if iteration.mode == mode:
                iteration.states.append(model.snapshot())
        if self.reader is not None and mode in self.seen:
            self.states[mode].append(model.snapshot())

    @rule(mode=KNOWN, before=COUNTS, index=INDEXES, after=COUNTS)
    def update_between(self, mode, before, index, after):
        """Some partitions have just been sealed, others are being sealed, and one goes on."""
        name = self.known(mode)
        self.append(name, before, "array")
        self.update(mode, index, 2**7 - 1)
        self.append(name, after, "array")

    @SELDOM
    @rule(
        mode=MODES,
        counts=st.lists(st.integers(0, 9), min_size=1, max_size=3),
        nbytes=BYTES,
        state=st.sampled_from(["closed", "open", "updated"]),
    )
    def merge(self, mode, counts, nbytes, state):
        self.others += 1
        folder, fields = self.root / f"other_{self.others}", self.fields_of(mode)
        numbers = self.draw(sum(counts))
        part = max(1, nbytes // max(each.nbytes for each in fields.values()))
        if sum(counts) > 3 * part:
            return
        with Dataset.create(folder, "run", max_file_size=size(nbytes)) as other:
            other.define_fields(mode, fields.values())
            for first, count in zip(itertools.accumulate([0, *counts]), counts, strict=False):
                other.append(mode, stored(fields, numbers[first : first + count]))
            if state == "updated" and len(numbers):
                numbers[0] = self.draw(1)[0]
                other.update(mode, 0, {n: b[0] for n, b in stored(fields, numbers[:1]).items()})
            if state == "closed":
                other.close()
            before = {path.name: path.read_bytes() for path in folder.iterdir()}
            self.dataset.merge(folder)
            assert before == {path.name: path.read_bytes() for path in folder.iterdir()}
        self.defined(mode, False)
        self.committed()
        model = self.modes[mode]
        model.add(numbers)
        model.open, left = False, len(numbers)
        while left:
            model.parts.append(Part(self.session, model.next_index(self.session), min(left, part)))
            left -= model.parts[-1].rows

    @SELDOM
    @rule(mode=KNOWN, which=st.integers(0, 50))
    def remove_partition(self, mode, which):
        mode = self.known(mode)
        self.committed()
        model = self.modes[mode]
        if not model.parts:
            return
        model.open = False
        which %= len(model.parts)
        part = model.parts[which]
        assert self.dataset.remove_partition(mode, part.index, part.session) == part.rows
        first = sum(each.rows for each in model.parts[:which])
        del model.parts[which]
        model.removed[part.session] = max(part.index, model.removed.get(part.session, -1))
        for name, numbers in model.numbers.items():
            model.numbers[name] = np.delete(numbers, slice(first, first + part.rows))
        self.iterations = [each for each in self.iterations if each.mode != mode]
        self.removed = True

    @SELDOM
    @rule(
        nbytes=BYTES, session=st.sampled_from(["run", "b"]), given=st.booleans(),
        durable=st.booleans(),
    )  # fmt: skip
    def reopen(self, nbytes, session, given, durable):
        self.dataset.close()
        self.committed()
        for call in (self.dataset.verify, self.dataset.flush, lambda: self.dataset["training"]):
            with pytest.raises(UsageError):
                call()
        with Dataset.open(self.folder) as dataset:
            self.compare_all(dataset)
        written = [p.session for m in self.modes.values() for p in m.parts]
        last = list(dict.fromkeys(written))[-1] if written else "run"
        self.dataset = Dataset.open(
            self.folder, writable=True, session=session if given else None,
            max_file_size=size(nbytes), durable=durable,
        )  # fmt: skip
        self.session, self.nbytes = session if given else last, nbytes
        assert self.dataset.session == self.session
        for model in self.modes.values():
            model.open = False
        self.views = dict.fromkeys(self.views)
        self.iterations = []

    # Reading ------------------------------------------------------------------------------------

    def compare_all(self, dataset):
        assert dataset.modes == list(self.modes)
        assert dataset.info == self.info
        table = iter(dataset.describe())
        for name, model in self.modes.items():
            assert dataset.fields(name) == model.fields
            assert list(dataset.fields(name)) == list(model.fields)
            assert dataset.num_samples(name) == model.rows
            for each in model.fields.values():
                view = dataset[name][each.name]
                assert view.shape == (model.rows, *each.shape)
                same(view[:], each, model.numbers[each.name])
                same(np.asarray(view), each, model.numbers[each.name])
                row = next(table)
                assert (row["mode"], row["field"]) == (name, each.name)
                assert (row["samples"], row["partitions"]) == (model.rows, len(model.parts))
                assert row["bytes"] == model.rows * each.nbytes
            check_statistics(dataset.normalization_of(name), model)
        assert dataset.verify() == []

    @invariant()
    def rows_are_right(self):
        """Whatever happened, committed rows are there; looking does not commit pending ones."""
        self.turn += 1
        for name, model in self.modes.items():
            if self.views[name] is None:
                self.views[name] = self.dataset[name]
                self.committed()
            view = self.views[name]
            fields = list(model.fields.values())
            chosen = fields[self.turn % len(fields)]
            assert len(view["n"]) == model.rows
            same(view[chosen.name][:], chosen, model.numbers[chosen.name])
        if self.turn % 3 == 1 and not any(model.pending for model in self.modes.values()):
            for name, model in self.modes.items():
                check_statistics(self.dataset.normalization_of(name), model)

    @SELDOM
    @rule()
    def read_all(self):
        self.committed()
        self.compare_all(self.dataset)

    @rule(mode=KNOWN, index=INDEXES, which=st.integers(0, 6))
    def read_by_index(self, mode, index, which):
        mode = self.known(mode)
        self.committed()
        model = self.modes[mode]
        index = index_of(index, model.rows)
        chosen = list(model.fields.values())[which % len(model.fields)]
        view = self.dataset[mode][chosen.name]
        expected = model.values(chosen.name)
        if isinstance(index, int) and not model.rows:
            with pytest.raises(IndexError):
                view[index]
            return
        found = view[index]
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected[index], strict=True)
        assert [np.asarray(row).tolist() for row in view] == expected.tolist()

    @SELDOM
    @rule(mode=KNOWN, kept=st.booleans())
    def normalization(self, mode, kept):
        mode = self.known(mode)
        self.committed()
        find = self.dataset.recompute_normalization if kept else self.dataset.normalization_of
        check_statistics(find(mode), self.modes[mode])

    @rule(
        mode=KNOWN, count=st.integers(1, 30), shuffle=st.booleans(), key=st.integers(0, 5),
        epochs=st.integers(0, 2), fields=st.integers(0, 2**7), dtype=st.sampled_from([None, "f4"]),
        reuse=st.booleans(), normalize=st.booleans(), how=HOW,
        free=st.sampled_from([None, 0, 2000]),
    )  # fmt: skip
    def batches(
        self, mode, count, shuffle, key, epochs, fields, dtype, reuse, normalize, how, free
    ):
        mode = self.known(mode)
        self.committed()
        model = self.modes[mode]
        names = ["n", *(n for k, n in enumerate(model.fields) if k and fields >> k & 1)]
        options = {
            "shuffle": shuffle, "seed": key, "epochs": epochs, "dtype": dtype, "reuse": reuse,
            "normalize": normalize, "order": how, "fields": names if fields else None,
        }  # fmt: skip
        if not model.rows:
            with pytest.raises(DatasetError, match="no samples"):
                self.dataset.batches(mode, count, **options)
            return
        with memory_of(free):
            found = [
                {name: block.copy() for name, block in batch.items()}
                for batch in self.dataset.batches(mode, count, **options)
            ]
        each = -(-model.rows // count)
        assert len(found) == each * epochs
        for epoch in range(epochs):
            here = found[epoch * each : (epoch + 1) * each]
            assert [len(batch["n"]) for batch in here[:-1]] == [count] * (each - 1)
            rows = {n: np.concatenate([batch[n] for batch in here]) for n in here[0]}
            assert list(rows) == (names if fields else list(model.fields))
            order = self.order_of(model, rows["n"])
            if not shuffle:
                assert order.tolist() == list(range(model.rows))
            else:  # whatever is read, of whatever type, with whatever memory and size of batches
                nbytes = sum(field.nbytes for field in model.fields.values())
                name = how or shuffling.choose_order(model.rows, nbytes)
                drawn = shuffling.make_order(
                    name, model.rows, nbytes, shuffling.key_of(shuffling.key_of(key), epoch)
                )
                assert order.tolist() == drawn.items(0, model.rows).tolist()
            self.check_rows(model, rows, order, dtype, normalize)

    def order_of(self, model, n):
        """The numbers of rows, each of which comes once, by their numbers in field n."""
        place = {number: row for row, number in enumerate(model.numbers["n"].tolist())}
        order = [place[number] for number in n.tolist()]
        assert sorted(order) == list(range(model.rows))
        return np.array(order, int)

    def check_rows(self, model, rows, order, dtype, normalize):
        for name, found in rows.items():
            expected = model.values(name)
            if expected.dtype.kind != "f":
                np.testing.assert_array_equal(found, expected[order], strict=True)
                continue
            expected = expected.astype(dtype or expected.dtype)
            if not normalize:
                np.testing.assert_array_equal(found, expected[order], strict=True)
                continue
            assert found.dtype == expected.dtype
            exact = model.values(name).astype("float64")
            deviation = exact.std(axis=0)
            exact = (exact - exact.mean(axis=0)) / np.where(deviation > 1e-9, deviation, 1)
            np.testing.assert_allclose(found, exact[order], atol=1e-3)

    @precondition(lambda self: len(self.iterations) < 3)
    @rule(
        mode=KNOWN, count=st.integers(1, 9), shuffle=st.booleans(), key=st.integers(0, 5),
        dtype=st.sampled_from([None, "f4"]), reuse=st.booleans(), how=HOW,
        free=st.sampled_from([None, 0]),
    )  # fmt: skip
    def begin_iteration(self, mode, count, shuffle, key, dtype, reuse, how, free):
        mode = self.known(mode)
        self.committed()
        model = self.modes[mode]
        if not model.rows:
            return
        options = {
            "shuffle": shuffle, "seed": key, "dtype": dtype, "reuse": reuse, "order": how,
        }  # fmt: skip
        with memory_of(free):
            whole = self.dataset.batches(mode, count, **options)
            order = self.order_of(model, np.concatenate([batch["n"].copy() for batch in whole]))
            batches = self.dataset.batches(mode, count, **options, epochs=1 if shuffle else 3)
            begun = Iteration(
                batches, mode, list(model.fields), dtype, count, order, [model.snapshot()],
                0 if shuffle else 2,
            )  # fmt: skip
            self.iterations.append(begun)
            self.advance(begun)

    @precondition(lambda self: self.iterations)
    @rule(which=st.integers(0, 2), times=st.integers(1, 4))
    def go_on(self, which, times):
        iteration = self.iterations[which % len(self.iterations)]
        for _ in range(times):
            if iteration in self.iterations:
                self.advance(iteration)

    def advance(self, iteration):
        """Read the next batch; an epoch has the rows that were committed when it began."""
        model = self.modes[iteration.mode]
        if iteration.done == len(iteration.order):
            if not iteration.more:
                with pytest.raises(StopIteration):
                    next(iteration.batches)
                self.iterations.remove(iteration)
                return
            iteration.more, iteration.done = iteration.more - 1, 0
            iteration.order, iteration.states = np.arange(model.rows), [model.snapshot()]
        batch = next(iteration.batches)
        rows = iteration.order[iteration.done : iteration.done + iteration.size]
        assert list(batch) == iteration.fields
        for name, found in batch.items():
            assert len(found) == len(rows)
            floating = found.dtype.kind == "f"
            several = [state[name][rows] for state in iteration.states]
            one_of(found, model.fields[name], several, iteration.dtype if floating else None)
        iteration.done += len(rows)

    @rule(mode=KNOWN)
    def trajectories(self, mode):
        mode = self.known(mode)
        self.committed()
        model = self.modes[mode]
        if "step" not in model.fields:
            with pytest.raises(DatasetError, match="trajectories"):
                self.dataset.episodes(mode)
            return
        found = self.dataset.episodes(mode)
        expected = episodes_of(model)
        assert [(e.env_id, e.episode, e.rows.tolist()) for e in found] == expected

    @rule(mode=KNOWN, part=st.sampled_from(["training", "validation"]), count=st.integers(1, 20),
          seed=st.integers(0, 3), free=st.sampled_from([None, 0]))  # fmt: skip
    def folds(self, mode, part, count, seed, free):
        """The rows of two folds are all rows, each in one of them."""
        mode = self.known(mode)
        self.committed()
        model, found = self.modes[mode], []
        for fold in (0, 1):
            view = View(folds=2, fold=fold, fold_seed=seed, order="stored")
            try:
                with (
                    memory_of(free),
                    view.open(count, data=self.dataset, mode=mode, part=part) as batches,
                ):
                    rows = [batch["n"].copy() for batch in batches] or [np.zeros(0)]
                    found.append(np.concatenate(rows))
                    place = [self.place(model, n) for n in found[-1].tolist()]
                    assert sorted(place) == batches.all_rows().tolist()
            except DatasetError as error:
                assert "nothing to read" in str(error)
                found.append(np.zeros(0))
        assert sorted(np.concatenate(found).tolist()) == sorted(model.numbers["n"].tolist())

    def place(self, model, number):
        return model.numbers["n"].tolist().index(number)

    # A reader beside the writer -----------------------------------------------------------------

    @SELDOM
    @rule()
    def open_reader(self):
        if self.reader is not None:
            self.reader.close()
        self.reader = Dataset.open(self.folder)
        self.now_seen()

    @precondition(lambda self: self.reader is not None)
    @rule()
    def refresh_reader(self):
        self.reader.refresh()
        kept = self.states
        removed = self.removed
        self.now_seen()
        if not removed:  # what was updated meanwhile may be seen as it was before
            for name, several in kept.items():
                self.states[name] = [*several, *self.states[name]]
        for name, count in self.seen.items():
            for each in self.modes[name].fields.values():
                same(self.reader[name][each.name][:], each, self.modes[name].numbers[each.name])
            assert self.reader.num_samples(name) == count
            if removed or len(self.states[name]) == 1:
                check_statistics(self.reader.normalization_of(name), self.modes[name])
        assert self.reader.verify() == []

    def now_seen(self):
        self.seen = {name: model.rows for name, model in self.modes.items()}
        self.states = {name: [model.snapshot()] for name, model in self.modes.items()}
        self.removed = False

    @precondition(lambda self: self.reader is not None)
    @rule(mode=MODES, count=st.integers(1, 30), index=INDEXES, free=st.sampled_from([None, 0]))
    def read_beside(self, mode, count, index, free):
        if mode not in self.seen:
            assert mode not in self.reader
            return
        rows = self.seen[mode]
        assert self.reader.num_samples(mode) == rows
        if not rows:
            return
        index = index_of(index, rows)
        fields = self.modes[mode].fields.values()
        try:
            by_index = {each.name: self.reader[mode][each.name][index] for each in fields}
            with memory_of(free):
                batches = list(self.reader.batches(mode, count))
        except DatasetError:
            assert self.removed  # its files are gone
            return
        for each in fields:
            several = [
                np.pad(state[each.name], (0, max(0, rows - len(state[each.name]))))[:rows]
                for state in self.states[mode]
            ]
            found = np.concatenate([batch[each.name] for batch in batches])
            one_of(found, each, several)
            found, several = by_index[each.name], [state[index] for state in several]
            if isinstance(index, int):
                found, several = found[None], [[number] for number in several]
            one_of(found, each, several)

    # Wrong calls --------------------------------------------------------------------------------

    @SELDOM
    @rule(mode=KNOWN, which=st.integers(0, 100), count=st.integers(1, 5))
    def wrong_call(self, mode, which, count):
        mode = self.known(mode)
        self.committed()
        self.dataset.flush()
        calls = list(self.wrong_calls(mode, count))
        error, call = calls[which % len(calls)]
        with pytest.raises(error) as caught:
            call()
        assert type(caught.value) is error
        assert self.dataset.modes == list(self.modes)

    def wrong_calls(self, mode, count):
        d, model = self.dataset, self.modes[mode]
        rows = stored(model.fields, self.draw(count))
        sample = {name: block[0] for name, block in rows.items()}
        total = model.rows
        yield FieldShapeError, lambda: d.append(mode, {**rows, "n": np.zeros((count, 2), int)})
        if len(rows) > 1:
            yield FieldShapeError, lambda: d.append(mode, {**rows, "n": np.zeros(count + 1, int)})
        yield FieldTypeError, lambda: d.append(mode, {**rows, "n": rows["n"] + 0.5})
        yield UnknownFieldError, lambda: d.append(mode, {**rows, "unknown": rows["n"]})
        yield UnknownFieldError, lambda: d.append_sample(mode, {**sample, "unknown": 1})
        yield FieldTypeError, lambda: d.append_sample(mode, {**sample, "n": "text"})
        yield MissingFieldError, lambda: d.append_sample(mode, {})
        yield MissingFieldError, lambda: d.append(mode, {})
        for name in [n for n in model.fields if n in ("x", "f", "large")]:
            bad = rows[name].copy()
            bad[count - 1] = np.nan
            yield NotFiniteError, lambda: d.append(mode, {**rows, name: bad})  # noqa: B023
            yield NotFiniteError, lambda: d.append_sample(mode, {**sample, name: bad[-1]})  # noqa: B023
            if total:
                yield NotFiniteError, lambda: d.update(mode, -1, {"n": 1, name: bad[-1]})  # noqa: B023
        yield IndexError, lambda: d.update(mode, total, {"n": 1})
        yield IndexError, lambda: d.update(mode, [-total - 1], {"n": [1]})
        yield IndexError, lambda: d.update(mode, [0.5], {"n": [1]})
        yield FieldShapeError, lambda: d.update(mode, slice(None), {"n": np.zeros(total + 1, int)})
        yield UnknownFieldError, lambda: d.update(mode, [], {"n": [], "unknown": []})
        yield MissingFieldError, lambda: d.update(mode, [], {})
        yield DatasetError, lambda: d.update("unknown", 0, {"n": 1})
        yield DatasetError, lambda: d["unknown"]
        yield DatasetError, lambda: d[mode]["unknown"]
        yield DatasetError, lambda: d.num_samples("unknown")
        yield IndexError, lambda: d[mode]["n"][total]
        yield IndexError, lambda: d[mode]["n"][-total - 1]
        yield IndexError, lambda: d[mode]["n"][np.array([total])]
        yield IndexError, lambda: d[mode]["n"][0, 0]
        yield ConfigError, lambda: d.batches(mode, 0)
        yield ConfigError, lambda: d.update_info(wrong=object())
        yield ConfigError, lambda: d.append("no identifier", rows)
        yield NotFiniteError, lambda: d.append("unknown", {"x": [np.nan]})
        yield FieldsMismatchError, lambda: d.define_fields(mode, [Field("n", (7,), "int64")])
        yield DatasetError, lambda: d.remove_partition(mode, 10**6)
        yield DatasetError, lambda: d.remove_partition("unknown", 0)
        yield DatasetError, lambda: d.merge(self.folder)
        yield DatasetNotFoundError, lambda: d.merge(self.root / "missing")
        yield FieldsMismatchError, lambda: d.merge(self.mismatching(mode))
        yield DatasetLockedError, lambda: Dataset.open(self.folder, writable=True)
        yield DatasetLockedError, lambda: Dataset.create(self.folder)
        yield DatasetLockedError, lambda: Dataset.repair(self.folder)
        reader = Dataset.open(self.folder)
        yield UsageError, lambda: reader.update(mode, 0, {"n": 1})
        yield UsageError, lambda: reader.append(mode, rows)
        yield UsageError, lambda: reader.remove_partition(mode, 0)
        yield UsageError, lambda: reader.merge(self.root)

    def mismatching(self, mode):
        """A dataset with a new mode, and with other fields in a mode that is there."""
        self.others += 1
        folder = self.root / f"other_{self.others}"
        with Dataset.create(folder) as other:
            other.append("new", {"y": [1.0]})
            other.append(mode, {"y": [1.0]})
        return folder


@contextlib.contextmanager
def memory_of(free):
    """So many bytes of memory are free; None: as many as there are."""
    if free is None:
        yield
        return
    with mock.patch.object(memory, "available_memory", lambda: free):
        yield


# Several writers --------------------------------------------------------------------------------


@dataclass
class Writer:
    """One of the writers, and what only it knows."""

    dataset: Dataset
    capacity: int
    part: list | None = None  # numbers of the partition that it goes on with
    pending: list = field(default_factory=list)
    seen: dict = field(default_factory=dict)  # partition to how many of its rows it has seen


class SharedMachine(RuleBasedStateMachine):
    """A dataset with several writers, whose rows come in the order of the partitions."""

    FIELDS = (NUMBER, OTHERS[0], OTHERS[2])

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=Path.cwd()))
        self.folder = self.root / "data"
        self.writers, self.parts, self.others, self.next_number = [], [], 0, 0
        self.reader = None

    def teardown(self):
        for opened in (*self.writers, *filter(None, [self.reader])):
            with contextlib.suppress(Exception):  # it would hide what failed before
                opened.dataset.close()
        shutil.rmtree(self.root)

    draw = Machine.draw

    @initialize(rows=st.integers(1, 12), durable=st.booleans())
    def create(self, rows, durable):
        made = Dataset.create(
            self.folder, shared=True, durable=durable, max_file_size=size(24 * rows)
        )
        made.define_fields("training", self.FIELDS)
        self.writers.append(Writer(made, rows))
        self.open_writer(rows, None)

    @precondition(lambda self: len(self.writers) < 3)
    @rule(rows=st.integers(1, 12), session=st.sampled_from([None, "run", "b"]))
    def open_writer(self, rows, session):
        made = Dataset.open(
            self.folder, writable=True, shared=True, session=session, max_file_size=size(24 * rows)
        )
        self.writers.append(Writer(made, rows))
        self.check_all(self.writers[-1])

    @precondition(lambda self: len(self.writers) > 1)
    @rule(which=st.integers(0, 2))
    def close_writer(self, which):
        writer = self.writers.pop(which % len(self.writers))
        writer.dataset.close()
        self.committed(writer)

    @rule()
    def close_all(self):
        while self.writers:
            writer = self.writers.pop()
            writer.dataset.close()
            self.committed(writer)
        with Dataset.open(self.folder, writable=True, max_file_size=size(240)) as dataset:
            self.check_all(Writer(dataset, 10))
            numbers = self.draw(3)
            dataset.append("training", stored({f.name: f for f in self.FIELDS}, numbers))
            self.parts.append(numbers.tolist())
        self.open_writer(7, None)

    def writer(self, which):
        return self.writers[which % len(self.writers)]

    def committed(self, writer, numbers=()):
        """Pending samples of a writer, and more rows, have been committed."""
        for number in [*writer.pending, *numbers]:
            if writer.part is None or len(writer.part) == writer.capacity:
                writer.part = []
                self.parts.append(writer.part)
            writer.part.append(int(number))
        writer.pending.clear()

    @rule(which=st.integers(0, 2), count=st.integers(0, 20))
    def append(self, which, count):
        writer, numbers = self.writer(which), self.draw(count)
        rows = stored({f.name: f for f in self.FIELDS}, numbers)
        writer.dataset.append("training", rows)
        self.committed(writer, numbers)

    @rule(which=st.lists(st.integers(0, 2), min_size=2, max_size=6), count=st.integers(1, 5))
    def append_in_turn(self, which, count):
        for each in which:
            self.append(each, count)
            other = self.writer(each + 1)
            other.dataset.refresh()
            self.committed(other)
            assert other.dataset["training"]["n"][:].tolist() == self.numbers()
            self.see(other)

    @rule(which=st.integers(0, 2), count=st.integers(1, 4))
    def append_samples(self, which, count):
        writer = self.writer(which)
        for number in self.draw(count):
            rows = stored({f.name: f for f in self.FIELDS}, [number])
            writer.dataset.append_sample("training", {n: block[0] for n, block in rows.items()})
            writer.pending.append(int(number))

    @rule(which=st.integers(0, 2), count=st.integers(0, 9), rows=st.integers(1, 9))
    def merge(self, which, count, rows):
        self.others += 1
        writer, folder, numbers = self.writer(which), self.root / f"{self.others}", self.draw(count)
        with Dataset.create(folder, max_file_size=size(24 * rows)) as other:
            other.define_fields("training", self.FIELDS)
            other.append("training", stored({f.name: f for f in self.FIELDS}, numbers))
        writer.dataset.merge(folder)
        self.committed(writer)
        writer.part = None
        self.parts += [numbers[k : k + rows].tolist() for k in range(0, count, rows)]

    @rule(which=st.integers(0, 2))
    def refresh(self, which):
        writer = self.writer(which)
        writer.dataset.refresh()
        self.committed(writer)
        self.check_all(writer)
        if any(self.parts):
            found = [b["n"].copy() for b in writer.dataset.batches("training", 7, reuse=True)]
            assert np.concatenate(found).tolist() == self.numbers()

    def numbers(self):
        return list(itertools.chain(*self.parts))

    def check_all(self, writer):
        """A writer that has just refreshed sees every committed row."""
        dataset, model = writer.dataset, Mode({f.name: f for f in self.FIELDS})
        model.add(np.array(self.numbers(), int))
        assert dataset.num_samples("training") == model.rows
        for each in self.FIELDS:
            same(dataset["training"][each.name][:], each, model.numbers[each.name])
        check_statistics(dataset.normalization_of("training"), model)
        assert dataset.verify() == []
        self.see(writer)

    @rule(which=st.integers(0, 2), free=st.sampled_from([None, 0]))
    def look(self, which, free):
        """Without refreshing, a writer sees its own rows, and those of others that it knew."""
        writer = self.writer(which)
        writer.dataset.flush()
        self.committed(writer)
        self.see(writer)
        if writer.dataset.num_samples("training"):
            with memory_of(free):
                batches = writer.dataset.batches("training", 7)
                found = [np.column_stack([b["n"], b["x"]]) for b in batches]
            rows = np.concatenate(found)
            np.testing.assert_array_equal(rows[:, 1:], values(OTHERS[0], rows[:, 0]))
            assert rows[:, 0].tolist() == writer.dataset["training"]["n"][:].tolist()

    def see(self, writer):
        """What is seen of each partition are its first rows, and never fewer than before."""
        left = writer.dataset["training"]["n"][:].tolist()
        for number, part in enumerate(self.parts):
            here = left[: next((k for k, (a, b) in enumerate(zip(left, part, strict=False))
                                if a != b), min(len(left), len(part)))]  # fmt: skip
            left = left[len(here) :]
            assert len(here) >= writer.seen.get(number, 0)
            assert part is not writer.part or len(here) == len(part)
            writer.seen[number] = len(here)
        assert not left

    @rule()
    def read(self):
        if self.reader is None:
            self.reader = Writer(Dataset.open(self.folder), 0)
        self.see(self.reader)
        self.reader.dataset.refresh()
        self.check_all(self.reader)

    @rule(which=st.integers(0, 2))
    def wrong_calls(self, which):
        writer = self.writer(which)
        for error, call in (
            (UsageError, lambda: writer.dataset.update("training", 0, {"n": 1})),
            (UsageError, lambda: writer.dataset.remove_partition("training", 0)),
            (MissingFieldError, lambda: writer.dataset.append("training", {"n": [1]})),
            (DatasetError, lambda: writer.dataset.merge(self.folder)),
            (FieldsMismatchError, lambda: writer.dataset.define_fields("training", [Field("z")])),
            (DatasetLockedError, lambda: Dataset.open(self.folder, writable=True)),
            (DatasetLockedError, lambda: Dataset.create(self.folder)),
        ):
            with pytest.raises(error):
                call()


# Each history has its own seed: from one seed, Hypothesis would make variations of few histories.


@pytest.mark.parametrize("number", range(trials(13, 6)))
def test_dataset_behaves_like_lists(number):
    run_state_machine_as_test(seed(number)(Machine), settings=QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(trials(4, 2)))
def test_dataset_of_concurrent_writers_behaves_like_lists(number):
    few = settings(QUICK, stateful_step_count=15)
    run_state_machine_as_test(seed(number)(SharedMachine), settings=few)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(100, 130))
def test_longer_histories(number):
    run_state_machine_as_test(seed(number)(Machine), settings=LONG)


@pytest.mark.faults
@pytest.mark.parametrize("number", range(100, 110))
def test_longer_histories_of_concurrent_writers(number):
    few = settings(QUICK, stateful_step_count=20)
    run_state_machine_as_test(seed(number)(SharedMachine), settings=few)
