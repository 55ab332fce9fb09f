import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset
from physx_core.dataset.read.access import memory
from physx_core.errors import ConfigError, DatasetError

N = 1003


@pytest.fixture(params=["memory", "mapped"])
def dataset(request, tmp_path, monkeypatch):
    """Rows whose x, y and id tell their number, in many partitions."""
    if request.param == "mapped":
        monkeypatch.setattr(memory, "available_memory", lambda: 0)
    ids = np.arange(N)
    with Dataset.create(tmp_path, max_file_size=2e-5) as dataset:
        dataset.append("training", {"x": ids[:, None] + [0.0, 0.5], "y": ids * 2.0, "id": ids})
        assert dataset.describe()[0]["partitions"] > 3
        yield dataset


def ids_of(batches):
    return np.concatenate([batch["id"] for batch in batches])


@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize("size", [1, 16, 1003, 5000])
def test_an_epoch_has_every_row_once(dataset, shuffle, size):
    batches = list(dataset.batches("training", size, shuffle=shuffle, seed=1))
    assert [len(batch["id"]) for batch in batches[:-1]] == [size] * (len(batches) - 1)
    assert len(batches) == -(-N // size)
    ids = ids_of(batches)
    assert_array_equal(np.sort(ids), np.arange(N))
    assert_array_equal(ids, np.arange(N)) if not shuffle else None
    for batch in batches:
        assert_array_equal(batch["x"], batch["id"][:, None] + [0.0, 0.5])
        assert_array_equal(batch["y"], batch["id"] * 2.0)


def test_each_epoch_is_a_new_permutation_and_the_seed_gives_them(dataset):
    ids = ids_of(dataset.batches("training", 100, shuffle=True, seed=3, epochs=2))
    first, second = ids[:N], ids[N:]
    assert not np.array_equal(first, second) and not np.array_equal(first, np.arange(N))
    assert_array_equal(np.sort(second), np.arange(N))
    again = ids_of(dataset.batches("training", 7, shuffle=True, seed=3, epochs=2))
    assert_array_equal(again, ids)
    other = ids_of(dataset.batches("training", 100, shuffle=True, seed=4))
    assert not np.array_equal(other, first)
    drawn = [ids_of(dataset.batches("training", 100, shuffle=True)) for _ in range(2)]
    assert not np.array_equal(*drawn)


def test_endless_epochs(dataset):
    batches = dataset.batches("training", 500, epochs=None)
    sizes = [len(batch["id"]) for batch in itertools.islice(batches, 7)]
    assert sizes == [500, 500, 3, 500, 500, 3, 500]


def test_fields_and_type(dataset):
    batch = next(dataset.batches("training", 10, fields=["id", "x"], dtype="float32"))
    assert list(batch) == ["id", "x"]
    assert batch["x"].dtype == np.float32 and batch["id"].dtype == np.int64
    assert_array_equal(batch["x"][:, 1], np.arange(10) + np.float32(0.5))


def test_arrays_are_reused_only_when_asked(dataset):
    reused = [batch["x"] for batch in dataset.batches("training", 500, reuse=True)]
    assert np.shares_memory(reused[0], reused[1]) and np.shares_memory(reused[0], reused[2])
    own = [batch["x"] for batch in dataset.batches("training", 500)]
    assert not np.shares_memory(own[0], own[1])
    assert_array_equal(np.concatenate(own)[:, 0], np.arange(N))


def test_a_later_epoch_includes_rows_added_meanwhile(dataset):
    batches = dataset.batches("training", 2000, epochs=3, reuse=True)
    assert len(next(batches)["id"]) == N
    new = {"x": np.full((2, 2), 0.0), "y": np.zeros(2), "id": np.array([N, N + 1])}
    dataset.append("training", new)
    assert_array_equal(next(batches)["id"], np.arange(N + 2))
    for row in range(3000):
        dataset.append_sample("training", {"x": np.zeros(2), "y": 0.0, "id": N + 2 + row})
    dataset.flush()
    assert_array_equal(next(batches)["id"], np.arange(2000))
    assert_array_equal(next(batches)["id"], np.arange(2000, 4000))


def test_index_arrays_across_partitions(dataset):
    index = np.random.default_rng(0).integers(0, N, 200)
    assert_array_equal(dataset["training"]["id"][index], index)
    assert_array_equal(dataset["training"]["y"][::-1], np.arange(N)[::-1] * 2.0)


@pytest.mark.parametrize("kind", ["int8", "uint8", "int16", "uint64"])
def test_index_arrays_of_any_integer_type(dataset, kind):
    index = np.array([0, 127, 5, 5], kind)
    for rows in (index, index[:1]) if kind[0] == "u" else (index, -1 - index):
        expected = np.arange(N)[rows]
        assert_array_equal(dataset["training"]["id"][rows], expected)
        dataset.update("training", rows, {"id": expected})
    assert_array_equal(dataset["training"]["id"], np.arange(N))


@pytest.mark.parametrize("options", [{"batch_size": 0}, {"batch_size": -1},
                                     {"batch_size": 1, "epochs": -1},
                                     {"batch_size": 1, "fields": []}])  # fmt: skip
def test_options_are_checked_at_once(dataset, options):
    with pytest.raises(ConfigError):
        dataset.batches("training", **options)


def test_nothing_to_read(dataset):
    assert dataset.num_samples("validation") == 0
    with pytest.raises(DatasetError, match="no mode"):
        dataset.batches("validation", 4)
    with pytest.raises(DatasetError, match='no field "z"'):
        dataset.batches("training", 4, fields=["z"])
    dataset.append("validation", {"x": np.empty((0, 2))})
    with pytest.raises(DatasetError, match="no samples"):
        dataset.batches("validation", 4)
