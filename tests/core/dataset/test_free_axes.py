"""Free axes: rows of any size, against the simplest model, a list of rows in memory."""

import shutil
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import Phase, settings
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
from physx_core.dataset import EpisodeRecord
from physx_core.errors import ConfigError, DatasetError, FieldShapeError, NotFiniteError

FIELDS = [
    Field("x", ("node", 2), unit="m"),
    Field("u", ("node",), "float32"),
    Field("edge", ("edge", 2), "int32", indexes="node"),
    Field("n", (), "int64"),
]


def row(number):
    """The row that is made from a number; some have no entries at all."""
    nodes, edges = number * 7 % 5, number * 3 % 4
    edges = edges if nodes else 0
    return {
        "x": number + np.arange(nodes * 2).reshape(nodes, 2) / 16,
        "u": np.full(nodes, number, "float32"),
        "edge": (np.arange(edges * 2).reshape(edges, 2) + number).astype("int32") % max(1, nodes),
        "n": np.array(number),
    }


def block(rows):
    return {field.name: [each[field.name] for each in rows] for field in FIELDS}


def size(nbytes):
    """`max_file_size` with room for so many bytes of rows."""
    return (2**14 + nbytes + 0.5) * 1e-9


def check_rows(dataset, rows, mode="training"):
    assert dataset.num_samples(mode) == len(rows)
    for field in FIELDS:
        found = dataset[mode][field.name][:]
        assert len(found) == len(rows)
        for each, expected in zip(found, rows, strict=True):
            np.testing.assert_array_equal(each, expected[field.name], strict=True)


def check_batch(batch, rows):
    """Compare a packed batch with its rows, one by one."""
    for axis in ("node", "edge"):
        sizes = np.diff(batch[f"{axis}_ptr"])
        assert batch[f"{axis}_batch"].tolist() == np.repeat(np.arange(len(rows)), sizes).tolist()
    for place, expected in enumerate(rows):
        nodes = slice(*batch["node_ptr"][place : place + 2])
        np.testing.assert_array_equal(batch["x"][nodes], expected["x"])
        np.testing.assert_array_equal(batch["u"][nodes], expected["u"])
        edges = batch["edge"][slice(*batch["edge_ptr"][place : place + 2])]
        np.testing.assert_array_equal(edges - nodes.start, expected["edge"])


def check_statistics(dataset, rows):
    found = dataset.normalization_of("training")
    for name in ("x", "u"):
        entries = np.concatenate([each[name] for each in rows]).astype(float)
        assert (name in found) == bool(len(entries))
        if len(entries):
            np.testing.assert_allclose(found[name].mean, entries.mean(0), rtol=1e-9)
            np.testing.assert_array_equal(found[name].maximum, entries.max(0))


class Machine(RuleBasedStateMachine):
    """A dataset with free axes, written, changed, merged, closed and opened."""

    def __init__(self):
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=Path.cwd()))
        self.rows, self.next, self.others = [], 0, 0
        self.dataset = None

    def teardown(self):
        if self.dataset is not None:
            self.dataset.close()
        shutil.rmtree(self.root)

    def draw(self, count):
        first, self.next = self.next, self.next + count
        return [row(number) for number in range(first, self.next)]

    @initialize(nbytes=st.sampled_from([40, 200, 700, 10**6]), durable=st.booleans())
    def create(self, nbytes, durable):
        self.nbytes = nbytes
        self.dataset = Dataset.create(
            self.root / "data", max_file_size=size(nbytes), durable=durable
        )
        self.dataset.define_fields("training", FIELDS)

    @rule(count=st.integers(0, 30), single=st.booleans())
    def append(self, count, single):
        rows = self.draw(count)
        if single:
            for each in rows:
                self.dataset.append_sample("training", each)
            self.dataset.flush()
        else:
            self.dataset.append("training", block(rows))
        self.rows += rows

    @precondition(lambda self: self.rows)
    @rule(places=st.lists(st.integers(0, 200), min_size=1, max_size=5, unique=True))
    def update(self, places):
        places = list(dict.fromkeys(place % len(self.rows) for place in places))
        new = [{**self.rows[p], "x": self.rows[p]["x"] + 0.5} for p in places]
        self.dataset.update("training", places, {"x": [each["x"] for each in new]})
        for place, each in zip(places, new, strict=True):
            self.rows[place] = each
        wrong = [np.zeros((len(each["x"]) + 1, 2)) for each in new]
        with pytest.raises(FieldShapeError, match="keep their sizes"):
            self.dataset.update("training", places, {"x": wrong})

    @rule(count=st.integers(0, 12), nbytes=st.sampled_from([100, 10**6]))
    def merge(self, count, nbytes):
        self.others += 1
        folder, rows = self.root / f"other_{self.others}", self.draw(count)
        with Dataset.create(folder, max_file_size=size(nbytes)) as other:
            other.define_fields("training", FIELDS)
            other.append("training", block(rows))
        self.dataset.merge(folder)
        self.rows += rows

    @precondition(lambda self: self.rows)
    @rule(which=st.integers(0, 50))
    def remove_partition(self, which):
        parts = self.dataset._manifest.modes["training"].partitions
        which %= len(parts)
        first, part = sum(each.rows for each in parts[:which]), parts[which]
        removed = self.dataset.remove_partition("training", part.index, part.session)
        del self.rows[first : first + removed]

    @rule(nbytes=st.sampled_from([40, 300, 10**6]), how=st.sampled_from(["", "repair", "rebuild"]))
    def reopen(self, nbytes, how):
        self.dataset.close()
        if how and self.rows:  # without rows, the files do not tell the fields
            getattr(Dataset, how)(self.root / "data")
        with Dataset.open(self.root / "data") as found:
            check_rows(found, self.rows)
            assert found.verify() == []
        self.dataset = Dataset.open(self.root / "data", writable=True, max_file_size=size(nbytes))

    @precondition(lambda self: self.rows)
    @rule(batch_size=st.integers(1, 20), seed=st.integers(0, 3))
    def batches(self, batch_size, seed):
        found = self.dataset.batches("training", batch_size, shuffle=True, seed=seed)
        known, seen = {int(each["n"]): each for each in self.rows}, 0
        for batch in found:
            check_batch(batch, [known[n] for n in batch["n"].tolist()])
            seen += len(batch["n"])
        assert seen == len(self.rows)
        with View(hold_back=False).open(batch_size, seed, data=self.dataset) as view:
            for batch in view:
                check_batch(batch, [known[n] for n in batch["n"].tolist()])

    @invariant()
    def rows_are_right(self):
        if self.dataset is not None:
            check_rows(self.dataset, self.rows)
            with Dataset.open(self.root / "data") as reader:
                check_rows(reader, self.rows)
            if self.rows:
                check_statistics(self.dataset, self.rows)


@pytest.mark.slow
@pytest.mark.reported(
    "pytorch_geometric#2961",
    "pytorch_geometric#2436",
    "pytorch_geometric#1243",
    "Minari#77",
    "deepmind-research#267",
    about="meshes and graphs of different sizes in one dataset",
)
def test_random_histories_of_free_axes_agree_with_lists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    count = trials(60, 6)
    run_state_machine_as_test(
        Machine,
        settings=settings(
            database=None,
            max_examples=count,
            stateful_step_count=15,
            deadline=None,
            phases=[Phase.generate],
        ),
    )


def write(folder, numbers, **options):
    with Dataset.create(folder, **options) as dataset:
        dataset.define_fields("training", FIELDS)
        dataset.append("training", block([row(n) for n in numbers]))


def test_index_of_free_axes_is_read_by_h5py(tmp_path):
    write(tmp_path, range(40), max_file_size=size(200))
    with h5py.File(tmp_path / "run.h5") as file:
        ptr = file["training/node_ptr"][:]
        for number in range(40):
            found = file["training/x"][ptr[number] : ptr[number + 1]]
            np.testing.assert_array_equal(found, row(number)["x"])


def test_partitions_of_free_axes_roll_over_when_any_file_is_full(tmp_path):
    write(tmp_path, range(40), max_file_size=size(320))
    with Dataset.open(tmp_path) as dataset:
        parts = dataset._manifest.modes["training"].partitions
        assert len(parts) > 2 and all(part.sizes["node"] <= 20 for part in parts)


def test_partitions_that_are_all_but_full_stay_as_they_were_written(tmp_path):
    """The entries of the next row rarely fit exactly; nothing is copied for the rest."""
    counts = [7] * 300
    rows = [np.full((count, 2), number / 8) for number, count in enumerate(counts)]
    with Dataset.create(tmp_path, max_file_size=size(1000 * 16)) as dataset:
        dataset.define_fields("training", [FIELDS[0]])
        dataset.append("training", {"x": rows[:100]})
        path = tmp_path / f"{dataset.session}_training_x_0.h5"
        inode = path.stat().st_ino
        dataset.append("training", {"x": rows[100:]})
    assert path.stat().st_ino == inode
    with h5py.File(path) as file:
        assert file["data"].shape == (1000, 2) and file["rows"][()] == 142 * 7
    with h5py.File(tmp_path / f"{dataset.session}.h5") as file:
        np.testing.assert_array_equal(file["training/x"][:], np.concatenate(rows))
    Dataset.rebuild(tmp_path)
    with Dataset.open(tmp_path) as found:
        assert found.verify() == []
        stored = np.concatenate(found["training"]["x"][:])
        np.testing.assert_array_equal(stored, np.concatenate(rows))


def test_a_row_larger_than_a_partition_is_stored(tmp_path):
    with Dataset.create(tmp_path, max_file_size=size(10)) as dataset:
        dataset.define_fields("training", [Field("x", ("node",))])
        dataset.append("training", {"x": [np.arange(1.0), np.arange(1000.0), np.arange(2.0)]})
        assert [len(each) for each in dataset["training"]["x"]] == [1, 1000, 2]


def test_fields_that_share_a_free_axis_have_the_same_sizes(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        dataset.define_fields("training", FIELDS)
        wrong = {**row(2), "u": np.zeros(1, "float32")}
        for call in (dataset.append_sample, lambda m, s: dataset.append(m, block([s]))):
            with pytest.raises(FieldShapeError, match='on the axis "node"'):
                call("training", wrong)


def test_numbers_of_entries_that_there_are_not_are_refused(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        dataset.define_fields("training", FIELDS)
        wrong = {**row(2), "edge": np.full((1, 2), 4)}
        with pytest.raises(FieldShapeError, match="from 4 to 4, but there are 4"):
            dataset.append("training", block([wrong]))


def test_values_of_free_axes_are_finite(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        dataset.define_fields("training", FIELDS)
        wrong = {**row(2), "u": np.full(4, np.nan, "float32")}
        with pytest.raises(NotFiniteError, match="row 1 of the block"):
            dataset.append("training", block([row(1), wrong]))
        with pytest.raises(NotFiniteError):
            dataset.append_sample("training", wrong)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ([Field("x", ("node",)), Field("node_ends", ())], "belongs to the axis"),
        ([Field("e", (2,), int, indexes="node")], "no field has it as a free axis"),
    ],
)
def test_free_axes_that_contradict_each_other_are_refused(tmp_path, fields, match):
    with Dataset.create(tmp_path) as dataset, pytest.raises(ConfigError, match=match):
        dataset.define_fields("training", fields)


def test_rows_of_any_size_without_a_free_axis_say_how_to_define_one(tmp_path):
    with Dataset.create(tmp_path) as dataset, pytest.raises(FieldShapeError, match="free axis"):
        dataset.append("training", {"x": [np.zeros(2), np.zeros(3)]})


def test_damaged_ends_of_a_free_axis_are_found(tmp_path):
    write(tmp_path, range(9))
    path = tmp_path / "run_training_node_ends_0.h5"
    with h5py.File(path) as file:
        place = file["data"].id.get_offset()
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    with Dataset.open(tmp_path) as dataset:
        assert len(dataset.verify()) == 1
    done = Dataset.repair(tmp_path)
    assert "9 rows of the partition cannot be used" in done[0]


def test_episodes_with_meshes_are_compacted_and_merged(tmp_path):
    mesh = [
        Field("vertex", ("vertex", 3), role="episode"),
        Field("face", ("face", 3), int, role="episode", indexes="vertex"),
    ]

    def once(number):
        return {
            "vertex": np.full((3 + number, 3), number, float),
            "face": np.full((number, 3), number),
        }

    def check(dataset, numbers):
        check_rows(dataset, [row(n * 3 + k) for n in numbers for k in range(3)])
        found = dataset.episode_values("training", "vertex", slice(None))
        assert [len(each) for each in found] == [3 + n for n in numbers for _ in range(3)]
        check_statistics(dataset, [row(n * 3 + k) for n in numbers for k in range(3)])
        assert dataset.verify() == []

    for folder in ("a", "b"):
        with Dataset.create(tmp_path / folder, max_file_size=size(250)) as dataset:
            dataset.define_fields("training", FIELDS)
            for number in (3, 0, 2, 1, 4):
                rows = block([row(number * 3 + k) for k in range(3)])
                dataset.append_episodes(
                    "training", rows, [EpisodeRecord(episode=number, rows=3, fields=once(number))],
                    episode_fields=mesh,
                )  # fmt: skip
            check(dataset, range(5))
    with Dataset.open(tmp_path / "a", writable=True, max_file_size=size(250)) as dataset:
        dataset.compact()
        check(dataset, range(5))
        dataset.merge(tmp_path / "b")
        check(dataset, [*range(5), *range(5)])
    with Dataset.open(tmp_path / "a") as dataset:
        check(dataset, [*range(5), *range(5)])


def test_removed_sizes_are_an_error_in_open_batches(tmp_path):
    write(tmp_path, range(40), max_file_size=size(300))
    view = View(hold_back=False)
    with Dataset.open(tmp_path, writable=True) as dataset, view.open(4, data=dataset) as batches:
        dataset.remove_partition("training", 0)
        with pytest.raises(DatasetError, match="open them again"):
            batches[0]


def test_edges_may_be_given_transposed(tmp_path):
    sides = np.arange(8).reshape(2, 4)
    with Dataset.create(tmp_path) as dataset:
        dataset.define_fields("training", [Field("e", ("edge", 2), "int64")])
        dataset.append("training", {"e": [sides.T, sides[:, :1].T]})
        assert [each.tolist() for each in dataset["training"]["e"][:]] == [
            sides.T.tolist(),
            [[0, 4]],
        ]
