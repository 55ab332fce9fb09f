"""Reading by index from many partitions, from damaged files, and while another process writes."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.dataset.read.access import memory
from physx_core.errors import DatasetError

pytestmark = pytest.mark.processes

ORDERS = ["exact", "blocks"]
WRITER = """
import os, sys, time
import numpy as np
from physx_core import Dataset
folder, enough = sys.argv[1:3]
rng, first = np.random.default_rng(0), 0
with Dataset.create(folder, max_file_size=2e-4) as dataset:
    while not os.path.exists(enough):
        ids = np.arange(first, first + rng.integers(1, 200))
        x = ids[:, None] + np.zeros(600 if len(sys.argv) > 3 else 3)
        dataset.append("training", {"id": ids, "x": x})
        first += len(ids)
        if first == len(ids):
            print("begun", flush=True)
        time.sleep(0.002)
print(first)
"""


def stored(folder, rows, partition_rows=None):
    """Store rows of fields by name, in partitions of the given number of rows."""
    count = len(next(iter(rows.values())))
    row_nbytes = max(1, max(values[0].nbytes for values in rows.values()))
    nbytes = row_nbytes * (partition_rows or count) + 2**14 + row_nbytes // 2
    with Dataset.create(folder, max_file_size=1e-9 * nbytes) as dataset:
        dataset.append("training", rows)
    return Dataset.open(folder)


# By index ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("partition_rows", [1, 7, 100, 1000])
@pytest.mark.parametrize("width", [1, 3, 64, 4097])
def test_rows_of_any_size_from_any_partitions(tmp_path, width, partition_rows):
    count = min(1000, 30 * partition_rows)
    rng = np.random.default_rng(0)
    rows = {
        "bytes": rng.integers(0, 256, (count, width), np.uint8),
        "number": np.arange(count),
        "nothing": np.empty((count, 0)),
    }
    with stored(tmp_path, rows, partition_rows if width > 8 else None) as dataset:
        index = rng.integers(-count, count, 500)
        for name, values in rows.items():
            assert_array_equal(dataset["training"][name][index], values[index])
            assert_array_equal(dataset["training"][name][::-1], values[::-1])


def test_what_is_returned_may_be_changed(tmp_path):
    with stored(tmp_path, {"x": np.arange(100)}, 30) as dataset:
        found = dataset["training"]["x"][[5, 50]]
        found[:] = -1
        assert_array_equal(dataset["training"]["x"][[5, 50]], [5, 50])


def test_too_small_an_address_space(tmp_path):
    with stored(tmp_path, {"x": np.zeros((12, 2**23), np.uint8)}, 4):
        pass
    code = (
        "import resource, sys; from physx_core import Dataset;"
        "view = Dataset.open(sys.argv[1])['training']['x'];"
        "limit = 2**20 * 60 + int(open('/proc/self/statm').read().split()[0]) * 4096;"
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit));"
        "view[[0, 11]]"
    )
    words = [sys.executable, "-c", code, str(tmp_path)]
    failed = subprocess.run(words, capture_output=True, text=True, check=False)
    assert failed.returncode == 1
    assert "100663296 bytes of address space are needed" in failed.stderr


# Damage -----------------------------------------------------------------------------------------


@pytest.fixture
def large_rows(tmp_path):
    """20 partitions of 50 rows of 4 kB."""
    ids = np.arange(1000)
    rows = {"x": ids[:, None] + np.zeros(512), "id": ids}
    with stored(tmp_path / "data", rows, 50) as dataset:
        assert dataset.describe()[0]["partitions"] == 20
        yield dataset


@pytest.mark.parametrize("free", [0, 10**9])
@pytest.mark.parametrize("damage", ["truncated", "missing", "damaged"])
def test_damage_before_reading(large_rows, monkeypatch, free, damage):
    monkeypatch.setattr(memory, "available_memory", lambda: free)
    path = large_rows.directory / "run_training_x_7.h5"
    if damage == "truncated":
        os.truncate(path, 100_000)
    elif damage == "missing":
        path.unlink()
    else:
        path.write_bytes(bytes(path.stat().st_size))
    with pytest.raises(DatasetError, match=rf"x_7\.h5.* {damage}"):
        list(large_rows.batches("training", 10, shuffle=True))
    with pytest.raises(DatasetError, match=rf"x_7\.h5.* {damage}"):
        large_rows["training"]["x"][[1, 2]]


@pytest.mark.parametrize("order", ["stored", "exact", "blocks"])
def test_truncation_during_read_is_an_error(large_rows, monkeypatch, order):
    monkeypatch.setattr(memory, "available_memory", lambda: 0)
    options = {"shuffle": order != "stored", "order": order}
    batches = large_rows.batches("training", 10, epochs=None, **options)
    next(batches)
    for number in range(20):
        os.truncate(large_rows.directory / f"run_training_x_{number}.h5", 100_000)
    with pytest.raises(DatasetError, match=r"became shorter|truncated"):
        for _ in range(300):
            next(batches)


def test_a_file_that_is_cut_between_two_readings_by_index(large_rows):
    view = large_rows["training"]["x"]
    assert_array_equal(view[[999, 1]][:, 0], [999, 1])
    path = large_rows.directory / "run_training_x_19.h5"
    os.truncate(path, 8192)
    with pytest.raises(DatasetError, match="truncated"):
        view[[999, 1]]


# Others write -----------------------------------------------------------------------------------


def test_new_rows_are_seen_after_refresh(tmp_path):
    with Dataset.create(tmp_path, max_file_size=3e-5) as writer:
        writer.define_fields("training", [Field("id", (), "int64"), Field("x", (2,))])
        with Dataset.open(tmp_path) as reader:
            count = 0
            for size in (1, 10, 500, 3000):
                ids = np.arange(count, count + size)
                writer.append("training", {"id": ids, "x": ids[:, None] * [1.0, 2.0]})
                assert reader.num_samples("training") == count
                reader.refresh()
                count += size
                assert reader.num_samples("training") == count
                index = np.arange(count - 1, -1, -1)
                assert_array_equal(reader["training"]["x"][index][:, 1], 2 * index)
                for order in ORDERS:
                    batches = reader.batches("training", 64, shuffle=True, order=order)
                    found = np.concatenate([batch["id"] for batch in batches])
                    assert_array_equal(np.sort(found), np.arange(count))


@pytest.mark.parametrize("large", [False, True])
@pytest.mark.parametrize("seconds", [2, pytest.param(8, marks=pytest.mark.faults)])
@pytest.mark.reported(
    "h5py#712",
    "h5py#2289",
    "h5py#2259",
    about="rows cannot be added while somebody reads, or after",
)
def test_read_during_concurrent_write(tmp_path, seconds, large):
    folder, enough = tmp_path / "dataset", tmp_path / "enough"
    words = [sys.executable, "-c", WRITER, str(folder), str(enough), *(["large"] * large)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout.readline() == "begun\n"
        rng, rounds, end = np.random.default_rng(0), 0, time.monotonic() + seconds
        with Dataset.open(folder) as dataset:
            while writer.poll() is None:
                check_all_rows(dataset, rng)
                with Dataset.open(folder) as other:
                    assert other.num_samples("training") >= dataset.num_samples("training")
                rounds += 1
                if rounds > 3 and time.monotonic() > end:
                    enough.touch()
                time.sleep(0.01)
            total = int(writer.stdout.read())
            dataset.refresh()
            check_all_rows(dataset, rng)
            assert dataset.num_samples("training") == total > 100
            assert dataset.verify() == []


def check_all_rows(dataset, rng):
    """Refresh and read what is new in every way."""
    before = dataset.num_samples("training")
    dataset.refresh()
    count = dataset.num_samples("training")
    assert count >= before
    index = rng.integers(0, count, 100)
    assert_array_equal(dataset["training"]["x"][index][:, 2], index)
    assert_array_equal(dataset["training"]["id"][-50:], np.arange(count)[-50:])
    for order in ORDERS:
        total = 0
        for batch in dataset.batches("training", 256, shuffle=True, seed=0, order=order):
            assert_array_equal(batch["x"], batch["id"][:, None] + np.zeros(batch["x"].shape[1]))
            total += batch["id"].sum()
        assert total == count * (count - 1) // 2
