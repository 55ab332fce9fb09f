import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import Dataset, Field
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


def rows(count, seed=0):
    random = np.random.default_rng(seed)
    return {
        "x": random.normal(size=(count, 5)),
        "y": random.normal(size=(count, 2, 3)).astype(np.float32),
        "flag": random.integers(0, 2, size=count).astype(bool),
        "count": random.integers(-1000, 1000, size=(count, 1)),
        "wave": random.normal(size=(count, 2)) + 1j * random.normal(size=(count, 2)),
    }


def same(dataset, mode, expected):
    assert dataset.num_samples(mode) == len(next(iter(expected.values())))
    for name, values in expected.items():
        stored = dataset[mode][name][:]
        assert stored.dtype == values.dtype
        assert_array_equal(stored, values)


def joined(*blocks):
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


@pytest.fixture
def dataset(folder):
    with Dataset.create(folder, max_file_size=0.001) as dataset:
        yield dataset


# Writing and reading back ---------------------------------------------------------------------


def test_round_trip(folder):
    blocks = [rows(count, seed) for seed, count in enumerate((1, 100, 7))]
    with Dataset.create(str(folder)) as dataset:
        for block in blocks:
            dataset.append("training", block)
        same(dataset, "training", joined(*blocks))
    with Dataset.open(folder) as dataset:
        assert dataset.modes == ["training"] and "training" in dataset
        assert list(dataset.fields("training")) == list(blocks[0])
        same(dataset, "training", joined(*blocks))
        assert dataset.verify() == []


def test_modes_are_apart(dataset, folder):
    dataset.append("training", {"x": np.ones((3, 2))})
    dataset.append("validation", {"x": np.zeros((4, 1)), "z": np.ones(4)})
    dataset.append("training", {"x": np.full((1, 2), 2.0)})
    assert dataset.num_samples("training") == 4 and dataset.num_samples("validation") == 4
    assert set(dataset["validation"]) == {"x", "z"}
    dataset.close()
    with Dataset.open(folder) as again:
        assert_array_equal(again["training"]["x"][:][:, 0], [1, 1, 1, 2])
        assert_array_equal(again["validation"]["z"], np.ones(4))


def test_samples_one_by_one(dataset):
    sent = rows(5000)
    for row in range(5000):
        dataset.append_sample("training", {name: values[row] for name, values in sent.items()})
    same(dataset, "training", sent)


def test_samples_and_blocks_keep_their_order(dataset):
    dataset.append_sample("training", {"x": 0.0})
    dataset.append("training", {"x": [1.0, 2.0]})
    dataset.append_sample("training", {"x": 3})
    dataset.append_sample("training", {"x": np.float32(4)})
    assert_array_equal(dataset["training"]["x"][:], [0, 1, 2, 3, 4])


def test_buffered_samples_are_stored_when_closed(folder):
    with pytest.raises(RuntimeError), Dataset.create(folder) as dataset:
        dataset.append_sample("training", {"x": np.ones(2)})
        raise RuntimeError
    with Dataset.open(folder) as dataset:
        assert dataset.num_samples("training") == 1


def test_flush_commits(dataset, folder):
    dataset.append_sample("training", {"x": np.ones(2)})
    dataset.flush()
    with Dataset.open(folder) as reader:
        assert reader.num_samples("training") == 1


def test_an_array_may_have_any_layout(dataset):
    values = np.arange(24.0).reshape(4, 6)
    dataset.append("training", {"x": values[:, ::2], "y": values.T[:4, :2].astype(">f8")})
    assert_array_equal(dataset["training"]["x"][:], values[:, ::2])
    assert_array_equal(dataset["training"]["y"][:], values.T[:4, :2])
    assert dataset["training"]["y"].dtype == np.dtype("<f8")


def test_a_field_without_values(dataset):
    dataset.append("training", {"x": np.ones((3, 1)), "none": np.empty((3, 0))})
    dataset.append("training", {"x": np.ones((2, 1)), "none": np.empty((2, 0))})
    assert dataset["training"]["none"][:].shape == (5, 0)
    batch = next(dataset.batches("training", 4, shuffle=True))
    assert batch["none"].shape == (4, 0)


def test_no_rows(dataset):
    dataset.append("training", {"x": np.empty((0, 3))})
    assert dataset.num_samples("training") == 0
    assert dataset["training"]["x"][:].shape == (0, 3)


def test_an_empty_dataset_opens(folder):
    Dataset.create(folder).close()
    with Dataset.open(folder) as dataset:
        assert dataset.modes == [] and dataset.describe() == [] and dataset.normalization == {}
        assert dataset.verify() == []


# Views ----------------------------------------------------------------------------------------


def test_rows_are_taken_as_from_an_array(dataset):
    values = np.arange(60.0).reshape(20, 3)
    dataset.append("training", {"x": values, "s": np.arange(20)})
    field = dataset["training"]["x"]
    assert len(field) == 20 and field.shape == (20, 3) and field.dtype == np.float64
    for index in (
        *(0, -1, np.int64(7)),
        *(slice(3, 9), slice(None, None, -2), slice(15, 99), slice(5, 2)),
        *([1, 1, -1], np.array([0, 19]), values[:, 0] > 30),
    ):
        assert_array_equal(field[index], values[index])
    assert field[[]].shape == (0, 3)
    assert_array_equal(np.asarray(field), values)
    assert np.asarray(field, np.float32).dtype == np.float32
    assert_array_equal(np.stack(list(field)), values)
    assert dataset["training"]["s"][3] == 3
    assert "training/x" in repr(field) and "20 samples" in repr(dataset["training"])


@pytest.mark.parametrize("index", [20, -21, [0, 20], [-21], [0.5], "x", (0, 1), [True]])
def test_rows_that_do_not_exist(dataset, index):
    dataset.append("training", {"x": np.zeros((20, 3))})
    with pytest.raises(IndexError):
        dataset["training"]["x"][index]


def test_what_is_read_is_a_copy(dataset):
    dataset.append("training", {"x": np.zeros((5, 2))})
    dataset["training"]["x"][:][...] = 1
    dataset["training"]["x"][[0, 1]][...] = 1
    for batch in dataset.batches("training", 5):
        batch["x"][...] = 1
    assert not dataset["training"]["x"][:].any()
    assert not next(dataset.batches("training", 5))["x"].any()


def test_a_view_sees_rows_that_are_added_later(dataset):
    dataset.append("training", {"x": np.arange(3.0)})
    field = dataset["training"]["x"]
    assert_array_equal(field[[2, 0]], [2, 0])
    dataset.append("training", {"x": np.arange(3.0, 5.0)})
    assert len(field) == 5
    assert_array_equal(field[[4, 0, 3]], [4, 0, 3])


def test_unknown_names_say_what_there_is(dataset):
    dataset.append("training", {"position": np.zeros(1)})
    with pytest.raises(DatasetError, match='Did you mean "training"'):
        dataset["trainin"]
    with pytest.raises(DatasetError, match='Did you mean "position"'):
        dataset["training"]["positon"]
    assert "positon" not in dataset["training"] and len(dataset["training"]) == 1
    with pytest.raises(DatasetError, match="Modes: training"):
        dataset.num_samples("validation")


# Fields ---------------------------------------------------------------------------------------

FIELDS = [
    Field("q", unit="rad"),
    Field("tau", (7,), "float32", unit="N m"),
    Field("seen", (), "bool", role="additional"),
]


def test_units_and_roles_are_kept(dataset, folder):
    dataset.define_fields("training", FIELDS)
    assert dataset.modes == ["training"] and dataset.num_samples("training") == 0
    dataset.append(
        "training", {"tau": np.ones((2, 7)), "q": np.zeros((2, 3)), "seen": [True, False]}
    )
    dataset.close()
    with Dataset.open(folder) as again:
        fields = again.fields("training")
        assert list(fields) == ["q", "tau", "seen"]
        assert fields["q"] == Field("q", (3,), unit="rad")
        assert fields["tau"] == FIELDS[1] and fields["seen"] == FIELDS[2]
        assert again.describe()[1] == {
            "mode": "training", "field": "tau", "role": "training", "dtype": "float32",
            "shape": (7,), "unit": "N m", "samples": 2, "partitions": 1, "bytes": 56,
        }  # fmt: skip


def test_a_defined_mode_without_rows_is_kept(dataset, folder):
    dataset.define_fields("validation", FIELDS)
    dataset.close()
    with Dataset.open(folder) as again:
        assert again.fields("validation")["q"] == FIELDS[0]
        assert again["validation"]["q"][:].shape == (0,)
        assert again.normalization_of("validation") == {}


def test_defining_again_completes_or_does_nothing(dataset):
    dataset.define_fields("training", FIELDS)
    dataset.define_fields("training", [Field("q", (3,), unit="rad"), *FIELDS[1:]])
    assert dataset.fields("training")["q"].shape == (3,)
    dataset.define_fields("training", FIELDS)
    assert dataset.fields("training")["q"].shape == (3,)


def test_other_fields_are_refused_one_by_one(dataset):
    dataset.append("training", {"x": np.zeros((1, 3)), "y": np.zeros(1), "z": np.zeros(1)})
    other = [Field("x", (4,), unit="m"), Field("y", (), "int32", role="additional"), Field("w")]
    with pytest.raises(FieldsMismatchError) as caught:
        dataset.define_fields("training", other)
    assert set(caught.value.differences) == {"x", "y", "z", "w"}
    assert "shape (3,), not (4,)" in caught.value.differences["x"]
    assert "unit '', not 'm'" in caught.value.differences["x"]
    assert "type float64, not int32" in caught.value.differences["y"]


def test_reserved_fields_are_additional(dataset):
    dataset.append("training", {"x": np.zeros(2), "env_id": [1, 2], "step": [0, 0]})
    roles = {name: field.role for name, field in dataset.fields("training").items()}
    assert roles == {"x": "training", "env_id": "additional", "step": "additional"}


@pytest.mark.parametrize("name", ["two words", "", "a/b"])
def test_a_modes_name_is_an_identifier(dataset, name):
    with pytest.raises(ConfigError):
        dataset.append(name, {"x": np.zeros(1)})
    with pytest.raises(ConfigError):
        dataset.define_fields("training", [])


# What cannot be stored ------------------------------------------------------------------------

GOOD = {"x": np.ones((2, 3)), "n": np.array([1, 2], "int32")}
BAD = {
    "missing": (MissingFieldError, {"x": np.ones((2, 3))}),
    "unknown": (UnknownFieldError, {**GOOD, "xx": np.ones(2)}),
    "shape": (FieldShapeError, {**GOOD, "x": np.ones((2, 4))}),
    "rank": (FieldShapeError, {**GOOD, "x": np.ones(2)}),
    "no axis": (FieldShapeError, {**GOOD, "n": np.int32(1)}),
    "ragged": (FieldShapeError, {**GOOD, "x": [[1, 2, 3], [1]]}),
    "length": (FieldShapeError, {**GOOD, "n": np.array([1], "int32")}),
    "kind": (FieldTypeError, {**GOOD, "n": np.array([1.5, 2.0])}),
    "too large": (FieldTypeError, {**GOOD, "n": np.array([1, 2**40])}),
    "text": (FieldTypeError, {**GOOD, "n": np.array(["a", "b"])}),
    "object": (FieldTypeError, {**GOOD, "n": np.array([None, {}])}),
    "nan": (NotFiniteError, {**GOOD, "x": np.array([[1, 1, 1], [1, np.nan, 1]])}),
    "inf": (NotFiniteError, {**GOOD, "x": np.array([[1, -np.inf, 1], [1, 1, 1]])}),
    "both": (NotFiniteError, {**GOOD, "x": np.array([[np.inf, -np.inf, 1], [1, 1, 1]])}),
    "many": (NotFiniteError, {"x": np.full((9000, 3), np.nan), "n": np.zeros(9000, "int32")}),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_rows_leave_the_dataset_as_it_is(dataset, folder, case):
    kind, bad = BAD[case]
    dataset.append("training", GOOD)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(kind) as caught:
        dataset.append("training", bad)
    assert caught.value.field in {"x", "n", "xx", ""}
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}
    dataset.append("training", GOOD)
    same(dataset, "training", joined(GOOD, GOOD))


@pytest.mark.parametrize("case", sorted(set(BAD) - {"length", "many", "no axis", "rank"}))
def test_wrong_samples_leave_the_buffer_as_it_is(dataset, case):
    kind, bad = BAD[case]
    good = {"x": np.ones(3), "n": 1}
    row = 1 if case in ("nan", "too large") else 0
    dataset.define_fields("training", [Field("x", (3,)), Field("n", (), "int32")])
    dataset.append_sample("training", good)
    sample = {name: values[row] for name, values in bad.items()}
    if case == "ragged":
        sample["x"] = [[1, 2], [3]]
    with pytest.raises(kind):
        dataset.append_sample("training", sample)
    dataset.append_sample("training", good)
    assert_array_equal(dataset["training"]["x"][:], np.ones((2, 3)))


def test_a_wrong_first_block_defines_nothing(dataset):
    for bad in ({"x": np.array([np.nan])}, {"x": 1.0}, {"x": np.array(["a"])}):
        with pytest.raises((NotFiniteError, FieldShapeError, FieldTypeError)):
            dataset.append("training", bad)
    assert dataset.modes == []


def test_large_finite_values_are_fine(dataset):
    values = np.full((3, 2), 1e300)
    dataset.append("training", {"x": values, "y": np.full(3, 3e38, "float32")})
    dataset.append_sample("training", {"x": values[0], "y": 3e38})
    assert dataset.num_samples("training") == 4
    with pytest.raises(NotFiniteError):
        dataset.append("training", {"x": values, "y": np.full(3, 1e300)})


# Opening --------------------------------------------------------------------------------------


def test_there_is_a_dataset_already(dataset, folder):
    dataset.close()
    with pytest.raises(DatasetError, match="already"):
        Dataset.create(folder)


def test_a_session_folder_will_do(tmp_path):
    Dataset.create(tmp_path / "session" / "dataset").close()
    Dataset.open(tmp_path / "session").close()


def test_not_found_says_what_is_there(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DatasetNotFoundError, match=r"notes\.txt"):
        Dataset.open(tmp_path)
    with pytest.raises(DatasetNotFoundError, match=r"does not exist.*notes\.txt"):
        Dataset.open(tmp_path / "missing")


def test_two_writers_are_refused_and_readers_are_not(dataset, folder):
    dataset.append("training", {"x": np.arange(3.0)})
    with pytest.raises(DatasetLockedError, match=f"Process {os.getpid()}"):
        Dataset.open(folder, writable=True)
    with Dataset.open(folder) as reader:
        assert_array_equal(reader["training"]["x"][:], np.arange(3.0))
        dataset.append("training", {"x": np.arange(3.0, 9.0)})
        assert reader.num_samples("training") == 3
        reader.refresh()
        assert_array_equal(reader["training"]["x"][:], np.arange(9.0))
        dataset.close()
        assert_array_equal(reader["training"]["x"][:], np.arange(9.0))
    Dataset.open(folder, writable=True).close()


def test_a_reader_cannot_write_and_a_closed_one_does_nothing(dataset, folder):
    dataset.append("training", GOOD)
    dataset.close()
    dataset.close()
    assert not dataset.writable
    with pytest.raises(UsageError, match="closed"):
        dataset.append("training", GOOD)
    with pytest.raises(UsageError, match="closed"):
        dataset["training"]
    with Dataset.open(folder) as reader:
        for write in (
            lambda: reader.append("training", GOOD),
            lambda: reader.append_sample("training", GOOD),
            lambda: reader.define_fields("training", FIELDS),
            lambda: reader.update_info(a=1),
            reader.flush,
        ):
            with pytest.raises(UsageError, match="writable=True"):
                write()


@pytest.mark.parametrize("options", [{"session": "a/b"}, {"session": ""}, {"max_file_size": 0}])
def test_options_are_checked(folder, options):
    with pytest.raises(ConfigError):
        Dataset.create(folder, **options)
    assert not folder.exists()


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="cannot be stored"):
        Dataset.create(tmp_path / "file" / "data")


def test_info_is_kept(folder):
    with Dataset.create(folder, info={"seed": 3}) as dataset:
        dataset.update_info(
            environment=Dataset, kwargs={"a": (1, 2.5), "b": np.arange(2), "p": Path("x")}
        )
        with pytest.raises(ConfigError):
            dataset.update_info(bad=object())
    with Dataset.open(folder) as dataset:
        assert dataset.info == {
            "seed": 3,
            "environment": "physx_core.dataset.dataset:Dataset",
            "kwargs": {"a": [1, 2.5], "b": [0, 1], "p": "x"},
        }
        assert set(dataset.versions) == {"python", "physx-core", "numpy", "h5py"}


# Normalization --------------------------------------------------------------------------------


def agrees(normalization, values):
    assert_allclose(normalization.mean, values.mean(axis=0), rtol=1e-9, atol=1e-12)
    assert_allclose(normalization.std, values.std(axis=0), rtol=1e-9)


def test_normalization_of_floating_fields(folder):
    sent = rows(1000)
    with Dataset.create(folder, max_file_size=3e-5) as dataset:
        for start in range(0, 1000, 100):
            dataset.append("training", {n: v[start : start + 100] for n, v in sent.items()})
            agrees(dataset.normalization["x"], sent["x"][: start + 100])
        dataset.append_sample("training", {name: values[0] for name, values in sent.items()})
        sent = joined(sent, {name: values[:1] for name, values in sent.items()})
        assert set(dataset.normalization) == {"x", "y"}
        agrees(dataset.normalization["x"], sent["x"])
    with Dataset.open(folder) as dataset:
        assert set(dataset.normalization_of("training")) == {"x", "y"}
        agrees(dataset.normalization["x"], sent["x"])
        agrees(dataset.normalization["y"], sent["y"].astype(np.float64))
        before = dataset.normalization["x"]
        again = dataset.recompute_normalization()["x"]
        assert_allclose(again.mean, before.mean, rtol=1e-12)
        assert_allclose(again.std, before.std, rtol=1e-12)


def test_normalization_goes_on_in_another_session(folder):
    first, second = rows(300, 1), rows(200, 2)
    with Dataset.create(folder, "one") as dataset:
        dataset.append("training", first)
    with Dataset.open(folder, writable=True, session="two") as dataset:
        dataset.append("training", second)
        agrees(dataset.normalization["x"], joined(first, second)["x"])
    with Dataset.open(folder) as dataset:
        agrees(dataset.normalization["x"], joined(first, second)["x"])
        same(dataset, "training", joined(first, second))


def test_a_constant_component_and_a_large_offset(dataset):
    values = np.random.default_rng(0).integers(-4, 4, size=(500, 2)) * 0.5 + 1e9
    values[:, 1] = 0.1
    dataset.append("training", {"x": values})
    normalization = dataset.normalization["x"]
    assert normalization.std[1] == 1 and normalization.mean[1] == 0.1
    assert_allclose(normalization.std[0], (values[:, 0] - 1e9).std(), rtol=1e-9)
