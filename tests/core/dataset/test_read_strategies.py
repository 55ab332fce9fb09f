"""How batches are read: from memory, exactly shuffled from the disk, or in windows."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import Dataset, Field, Normalization
from physx_core.dataset.read.strategies import memory
from physx_core.errors import ConfigError, DatasetError

pytestmark = pytest.mark.processes

STRATEGIES = ["memory", "disk exact", "disk windowed"]


@pytest.fixture
def no_memory(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 0)


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


def ids_of(batches):
    return np.concatenate([batch["id"] for batch in batches])


# Choosing ---------------------------------------------------------------------------------------


def test_what_fits_is_read_into_memory(tmp_path):
    with stored(tmp_path, 100, 3) as dataset:
        assert dataset.reading_strategy("training") == "memory"


@pytest.mark.parametrize(
    ("width", "names", "strategy"),
    [
        (3, None, "disk windowed"),
        (512, None, "disk exact"),
        (512, ["id", "y"], "disk windowed"),
        (509, None, "disk windowed"),
        (511, None, "disk exact"),  # 4096 bytes and 4
    ],
)
def test_row_size_decides_how_large_fields_are_read(tmp_path, no_memory, width, names, strategy):
    with stored(tmp_path, 100, width) as dataset:
        assert dataset.reading_strategy("training", names) == strategy


def test_fields_in_memory_need_no_more_of_it(tmp_path, monkeypatch):
    with stored(tmp_path, 100, 3) as dataset:
        list(dataset.batches("training", 10))
        monkeypatch.setattr(memory, "available_memory", lambda: 0)
        assert dataset.reading_strategy("training") == "memory"


def test_a_strategy_that_does_not_exist(tmp_path):
    with stored(tmp_path, 10, 3) as dataset:
        with pytest.raises(ConfigError, match='no reading strategy "ram".*disk exact.*memory'):
            dataset.batches("training", 2, strategy="ram")
        with pytest.raises(DatasetError, match='no field "z"'):
            dataset.reading_strategy("training", ["z"])


def test_memory_is_known():
    assert memory.available_memory() > 2**20


def test_limits_of_the_process_count():
    code = (
        "import resource; from physx_core.dataset.read.strategies.memory import available_memory;"
        "resource.setrlimit(resource.RLIMIT_AS, (2**32, 2**32)); print(available_memory())"
    )
    words = [sys.executable, "-c", code]
    out = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert 2**20 < int(out) < 2**32


# Orders -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [None, "float32", "float64"])
def test_rows_from_the_disk_are_those_from_memory(tmp_path, no_memory, dtype):
    with stored(tmp_path, 1000, 7) as dataset:
        for shuffle in (False, True):
            batches = [
                list(dataset.batches("training", 64, shuffle=shuffle, seed=3, epochs=2,
                                     dtype=dtype, strategy=strategy))
                for strategy in ("memory", "disk exact")
            ]  # fmt: skip
            assert len(batches[0]) == len(batches[1]) == 32
            for first, second in zip(*batches, strict=True):
                for name in ("x", "y", "id"):
                    assert first[name].dtype == second[name].dtype
                    assert_array_equal(first[name], second[name])


def test_the_order_of_writing_is_the_same_in_all(tmp_path):
    with stored(tmp_path, 1000, 7) as dataset:
        for strategy in STRATEGIES:
            assert_array_equal(
                ids_of(dataset.batches("training", 33, strategy=strategy)), range(1000)
            )


def test_small_fields_are_in_memory_beside_large_ones(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 50_000)
    with stored(tmp_path, 500, 600) as dataset:
        assert dataset.reading_strategy("training") == "disk exact"
        for batch in dataset.batches("training", 64, shuffle=True):
            assert_array_equal(batch["x"][:, 0], batch["id"])
            assert_array_equal(batch["y"], 2 * batch["id"])


def test_more_partitions_than_files_are_kept_open(tmp_path, no_memory):
    with stored(tmp_path, 1400, 512, partitions=70) as dataset:
        before = len(open_files())
        batches = dataset.batches("training", 100, shuffle=True)
        ids = ids_of([next(batches) for _ in range(14)])
        assert len(open_files()) == before + 3 * 64
        assert_array_equal(np.sort(ids), range(1400))
        batches.close()
        assert len(open_files()) == before


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    """More rows than three windows: 5 million of 24 bytes."""
    folder, count = tmp_path_factory.mktemp("wide"), 5_000_000
    ids = np.arange(count)
    with Dataset.create(folder, max_file_size=0.01) as dataset:
        dataset.append("training", {"x": ids[:, None] + [0.0, 0.5], "id": ids})
    return folder


def test_windows_yield_every_row_once_from_all_over(wide):
    with Dataset.open(wide) as dataset:
        ids, count = np.empty(5_000_000, np.int64), 0
        batches = dataset.batches(
            "training", 1024, shuffle=True, seed=1, reuse=True, strategy="disk windowed"
        )
        for number, batch in enumerate(batches):
            if number % 500 == 0:
                assert_array_equal(batch["x"][:, 1], batch["id"] + 0.5)
                assert len(np.unique(batch["id"] // 21845)) > 32  # blocks of half a megabyte
            ids[count : count + len(batch["id"])] = batch["id"]
            count += len(batch["id"])
        assert count == len(ids)
        assert np.bincount(ids, minlength=len(ids)).max() == 1
        other = dataset.batches(
            "training", 100_000, shuffle=True, seed=1, epochs=2, strategy="disk windowed"
        )
        found = [next(other)["id"] for _ in range(51)]
        assert_array_equal(np.concatenate(found[:50]), ids)  # whatever the size of batches
        assert not np.array_equal(found[50], ids[:100_000])


# Normalization ----------------------------------------------------------------------------------


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("dtype", [None, "float32"])
@pytest.mark.parametrize("reuse", [False, True])
def test_normalized_in_place(tmp_path, strategy, dtype, reuse):
    with stored(tmp_path, 300, 4) as dataset:
        known = dataset.normalization
        epochs = dataset.batches(
            "training", 64, shuffle=True, epochs=2, dtype=dtype, reuse=reuse, strategy=strategy,
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
        assert_array_equal(next(dataset.batches("training", 300, strategy=strategy))["y"][5], 10)


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
