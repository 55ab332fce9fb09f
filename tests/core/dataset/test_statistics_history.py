"""Statistics after any history of a dataset are, bit for bit, those of its rows read anew."""

import contextlib
import itertools
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from numpy.testing import assert_allclose
from sizes import trials

from physx_core import Dataset, Field, View
from physx_core.dataset import EpisodeRecord
from physx_core.dataset.read import mode_statistics, ordered_statistics
from physx_core.dataset.read import reader as reading
from physx_core.dataset.store.partition import segment
from physx_core.errors import DatasetError

FIELDS = (
    Field("u", (2, 3), "float32", axes=("channel", "x")),
    Field("v", (2,)),
    Field("wide", (20,)),
)
FEW = settings(database=None, max_examples=2, stateful_step_count=15, phases=[Phase.generate])
WHOLE = {"u": (0, 2), "v": (0,), "wide": (0,)}


@pytest.fixture(autouse=True)
def little_at_a_time(monkeypatch):
    """A few rows fill blocks and cells."""
    for module in (reading, segment, mode_statistics, ordered_statistics):
        monkeypatch.setattr(module, "rows_per_block", lambda nbytes: max(1, 400 // max(1, nbytes)))
    monkeypatch.setattr(ordered_statistics, "_FEWEST", 4)
    monkeypatch.setattr(ordered_statistics, "_MOST", 6)
    monkeypatch.setattr(ordered_statistics, "_KEPT", 4000)


class Machine(RuleBasedStateMachine):
    """Writes episodes, or plain rows, in any order; replaces, updates and removes some."""

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        self.count, self.numbers = itertools.count(), np.random.default_rng(0)

    def teardown(self):
        with contextlib.suppress(AttributeError):
            self.dataset.close()
        shutil.rmtree(self.root)

    @initialize(episodes=st.booleans())
    def create(self, episodes):
        self.episodes, size = episodes, 2**14 + 700
        self.dataset = Dataset.create(self.root / "data", max_file_size=size * 1e-9)
        self.dataset.define_fields("training", FIELDS)

    @property
    def rows(self):
        return self.dataset.num_samples("training")

    def some(self, count):
        return {f.name: self.numbers.normal(5, 1, (count, *f.shape)) for f in FIELDS}

    def store(self, dataset, number, count):
        if self.episodes:
            record = EpisodeRecord(episode=number, rows=count)
            dataset.append_episodes("training", self.some(count), [record])
        else:
            dataset.append("training", self.some(count))

    @rule(number=st.integers(0, 12), count=st.integers(1, 11))
    def append(self, number, count):
        self.store(self.dataset, number, count)

    @precondition(lambda self: self.rows)
    @rule(data=st.data())
    def update(self, data):
        rows = np.array(data.draw(st.lists(st.integers(0, self.rows - 1), min_size=1, max_size=3)))
        self.dataset.update("training", rows, self.some(len(rows)))

    @precondition(lambda self: self.dataset.contents("training"))
    @rule(data=st.data())
    def remove(self, data):
        known = sorted({entry[:2] for entry in self.dataset.contents("training")
                        if "/" not in entry[0]})  # fmt: skip
        if known:
            session, index = data.draw(st.sampled_from(known))
            self.dataset.remove_partition("training", index, session=session)

    @rule(number=st.integers(0, 12), count=st.integers(1, 11))
    def merge(self, number, count):
        other = self.root / f"other{next(self.count)}"
        with Dataset.create(other) as dataset:
            dataset.define_fields("training", FIELDS)
            self.store(dataset, number, count)
            self.store(dataset, number + 1, count)
        self.dataset.merge(other)

    @rule()
    def open_again(self):
        self.dataset.close()
        self.dataset = Dataset.open(self.root / "data", writable=True)

    @rule(damage=st.booleans())
    def lose_what_is_stored(self, damage):
        for path in (self.root / "data").glob("order_*"):
            path.write_bytes(path.read_bytes()[:-1]) if damage else path.unlink()

    @invariant()
    def statistics_are_those_of_the_rows(self):
        if not hasattr(self, "dataset") or not self.rows:
            return
        found = self.dataset.normalization_of("training")
        for name, axes in WHOLE.items():
            rows = self.dataset["training"][name][:].astype(float)
            assert_allclose(found[name].mean.ravel(), rows.mean(axes).ravel(), rtol=1e-9)
            assert_allclose(found[name].std.ravel(), rows.std(axes).ravel(), rtol=1e-6)
        folds = self.folds(self.dataset)
        with Dataset.open(self.root / "data") as reader:
            reader.recompute_normalization()
            same(reader.normalization_of("training"), found)
            for one, other in zip(self.folds(reader), folds, strict=True):
                same(one, other)

    def folds(self, dataset):
        found = []
        for part in ("training", "validation"):
            # A part may be empty.
            with (
                contextlib.suppress(DatasetError),
                View(fold=1).open(8, data=dataset, part=part) as batches,
            ):
                found.append(batches.normalization())
        return found


def same(one, other):
    assert one.keys() == other.keys()
    for name in one:
        for part, array in one[name].arrays().items():
            assert array.tobytes() == other[name].arrays()[part].tobytes(), (name, part)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(trials(10, 4)))
def test_statistics_after_any_history_are_those_of_the_rows_read_anew(number):
    run_state_machine_as_test(seed(number)(Machine), settings=FEW)
