"""Batches from memory and from the disk: the same, whatever memory is free."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import Dataset, Field, Normalization
from physx_core.dataset.read import shuffling
from physx_core.dataset.read.access import memory
from physx_core.errors import ConfigError

pytestmark = pytest.mark.processes

ORDERS = ["stored", "exact", "blocks"]


@pytest.fixture
def free(monkeypatch):
    """Return a function that sets the number of free bytes."""
    return lambda nbytes: monkeypatch.setattr(memory, "available_memory", lambda: nbytes)


def stored(folder, count, width, partitions=5):
    """Rows of `width` + 1 numbers that tell the row's number, and a column of numbers."""
    ids = np.arange(count)
    nbytes = 8 * width * -(-count // partitions) + 2**14 + 8
    with Dataset.create(folder, max_file_size=1e-9 * nbytes) as made:
        fields = [Field("x", (width,)), Field("y", (), "float32"), Field("id", (), "int64")]
        made.define_fields("training", fields)
        made.append(
            "training",
            {"x": ids[:, None] + np.linspace(0, 0.5, width), "y": 2.0 * ids, "id": ids},
        )
        assert made.describe()[0]["partitions"] == partitions
    return Dataset.open(folder)


def open_files():
    return list(Path("/proc/self/fd").iterdir())


def open_fields(folder):
    """The names of a dataset's fields with open files."""
    paths = [path.readlink() for path in open_files() if path.is_symlink()]
    return {p.name.split("_")[-2] for p in paths if folder in p.parents and "_training_" in p.name}


def ids_of(batches):
    return np.concatenate([batch["id"] for batch in batches])


# Orders -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [None, "float32", "float64"])
@pytest.mark.parametrize("order", ORDERS)
def test_free_memory_changes_no_batch(tmp_path, free, dtype, order):
    options = {"shuffle": order != "stored", "order": order, "seed": 3, "epochs": 2}
    with stored(tmp_path, 1000, 7) as dataset:
        found = []
        for nbytes in (0, 10_000, 10**12):
            free(nbytes)
            found.append(list(dataset.batches("training", 64, dtype=dtype, **options)))
        assert {len(each) for each in found} == {32}
        for first, second, third in zip(*found, strict=True):
            for name in ("x", "y", "id"):
                assert_array_equal(first[name], second[name], strict=True)
                assert_array_equal(first[name], third[name], strict=True)


@pytest.mark.parametrize("order", ["exact", "blocks"])
def test_the_fields_that_are_read_change_no_batch(tmp_path, free, order):
    free(0)
    with stored(tmp_path, 5000, 30) as dataset:
        several = [
            ids_of(dataset.batches("training", 64, shuffle=True, seed=1, order=order, fields=names))
            for names in (["id"], ["id", "y"], None)
        ]
        assert_array_equal(several[0], several[1])
        assert_array_equal(several[0], several[2])


@pytest.mark.parametrize("order", ORDERS)
def test_the_first_batch_may_be_any(tmp_path, free, order):
    free(0)
    options = {"shuffle": order != "stored", "order": order, "seed": 3, "epochs": 3}
    with stored(tmp_path, 1000, 7) as dataset:
        whole = list(dataset.batches("training", 64, **options))
        for first in (0, 1, 15, 16, 17, 40, 47):
            rest = list(dataset.batches("training", 64, first=first, **options))
            assert len(rest) == 48 - first
            for one, other in zip(rest, whole[first:], strict=True):
                assert_array_equal(one["id"], other["id"])
        assert list(dataset.batches("training", 64, first=48, **options)) == []


def test_default_order_depends_on_number_and_size_of_samples_alone(tmp_path):
    with stored(tmp_path / "a", 100, 3) as dataset:
        assert dataset.default_order("training") == "exact"
    assert shuffling.choose_order(2**21, 48) == "exact"
    assert shuffling.choose_order(2**21 + 1, 48) == "blocks"
    assert shuffling.choose_order(2**30, 4096) == "exact"


def test_an_order_that_does_not_exist(tmp_path):
    with stored(tmp_path, 10, 3) as dataset:
        with pytest.raises(ConfigError, match='no order "random".*blocks, exact'):
            dataset.batches("training", 2, shuffle=True, order="random")
        with pytest.raises(ConfigError, match="first is -1"):
            dataset.batches("training", 2, first=-1)


def test_memory_is_known():
    assert memory.available_memory() > 2**20


def test_limits_of_the_process_count():
    code = (
        "import resource; from physx_core.dataset.read.access.memory import available_memory;"
        "resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32)); print(available_memory())"
    )
    words = [sys.executable, "-c", code]
    out = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert 2**20 < int(out) < 2**32


def test_small_fields_are_in_memory_beside_large_ones(tmp_path, free):
    free(50_000)
    with stored(tmp_path, 500, 600) as dataset:
        batches = dataset.batches("training", 64, shuffle=True)
        next(batches)
        assert len(open_fields(tmp_path)) == 1
        for batch in dataset.batches("training", 64, shuffle=True):
            assert_array_equal(batch["x"][:, 0], batch["id"])
            assert_array_equal(batch["y"], 2 * batch["id"])


def test_more_partitions_than_files_are_kept_open(tmp_path, free):
    free(0)
    with stored(tmp_path, 1400, 512, partitions=70) as dataset:
        before = len(open_files())
        batches = dataset.batches("training", 100, shuffle=True)
        ids = ids_of([next(batches) for _ in range(14)])
        assert len(open_files()) == before + 3 * 64
        assert_array_equal(np.sort(ids), range(1400))
        batches.close()
        assert len(open_files()) == before


def test_batches_in_blocks_have_every_row_once_from_all_over(tmp_path, monkeypatch):
    monkeypatch.setattr(shuffling, "_WINDOW", 64)
    count = 500_000  # three windows
    ids = np.arange(count)
    with Dataset.create(tmp_path, max_file_size=0.002) as dataset:
        dataset.append("training", {"x": ids[:, None] + [0.0, 0.5], "id": ids})
    with Dataset.open(tmp_path) as dataset:
        options = {"shuffle": True, "seed": 1, "order": "blocks"}
        found = []
        for number, batch in enumerate(dataset.batches("training", 1024, reuse=True, **options)):
            if number % 50 == 0:
                assert_array_equal(batch["x"][:, 1], batch["id"] + 0.5)
                assert len(np.unique(batch["id"] // 2730)) > 40  # blocks of 64 kB
            found.append(batch["id"].copy())
        found = np.concatenate(found)
        assert_array_equal(np.sort(found), ids)
        other = dataset.batches("training", 100_000, epochs=2, **options)
        again = [next(other)["id"] for _ in range(6)]
        assert_array_equal(np.concatenate(again[:5]), found)  # whatever the size of batches
        assert not np.array_equal(again[5], found[:100_000])


# Normalization ----------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["exact", "blocks"])
@pytest.mark.parametrize("dtype", [None, "float32"])
@pytest.mark.parametrize("reuse", [False, True])
def test_normalized_in_place(tmp_path, order, dtype, reuse):
    with stored(tmp_path, 300, 4) as dataset:
        known = dataset.normalization
        epochs = dataset.batches(
            "training", 64, shuffle=True, epochs=2, dtype=dtype, reuse=reuse, order=order,
            normalize=True,
        )  # fmt: skip
        for batch in epochs:
            x = batch["id"][:, None] + np.linspace(0, 0.5, 4)
            tolerance = 1e-12 if dtype is None else 1e-5
            assert_allclose(batch["x"], (x - known["x"].mean) / known["x"].std, atol=tolerance)
            y = (2 * batch["id"] - known["y"].mean) / known["y"].std
            assert_allclose(batch["y"], y, atol=1e-5)
            assert batch["id"].dtype == np.int64 and batch["y"].dtype == np.float32
        assert_array_equal(dataset["training"]["id"][:], range(300))
        assert_array_equal(next(dataset.batches("training", 300))["y"][5], 10)


def test_normalized_by_what_is_given(tmp_path):
    with stored(tmp_path, 300, 4) as dataset:
        given = {"y": Normalization(np.array(10.0), np.array(4.0))}
        batch = next(dataset.batches("training", 300, normalize=given))
        assert_array_equal(batch["y"], (2.0 * np.arange(300) - 10) / 4)
        assert_array_equal(batch["x"][:, 0], range(300))


def test_constant_components_become_zero(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        x = np.stack([np.full(50, 1e6 / 3), np.arange(50.0)], 1)
        dataset.append("training", {"x": x, "flag": x[:, 0] > 0})
        batch = next(dataset.batches("training", 50, normalize=True))
        assert_array_equal(batch["x"][:, 0], 0.0)
        assert_allclose(batch["x"][:, 1].std(), 1)
        assert batch["flag"].all() and batch["flag"].dtype == bool
