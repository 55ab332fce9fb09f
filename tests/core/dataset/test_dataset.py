"""Reading back what was written: rows, views of them, their normalization."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import Dataset
from physx_core.errors import DatasetError


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


def test_modes_are_independent(dataset, folder):
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


def test_views_are_indexed_like_arrays(dataset):
    values = np.arange(60.0).reshape(20, 3)
    dataset.append("training", {"x": values, "s": np.arange(20)})
    field = dataset["training"]["x"]
    assert len(field) == 20 and field.shape == (20, 3) and field.dtype == np.float64
    for index in (
        *(0, -1, np.int64(7), np.array(3), np.array(-2, "i1")),
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


def test_unknown_names_list_the_known_ones(dataset):
    dataset.append("training", {"position": np.zeros(1)})
    with pytest.raises(DatasetError, match='Did you mean "training"'):
        dataset["trainin"]
    with pytest.raises(DatasetError, match='Did you mean "position"'):
        dataset["training"]["positon"]
    assert "positon" not in dataset["training"] and len(dataset["training"]) == 1
    with pytest.raises(DatasetError, match="Modes: training"):
        dataset["validation"]
    assert dataset.num_samples("validation") == 0


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


def test_normalization_continues_in_next_session(folder):
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
