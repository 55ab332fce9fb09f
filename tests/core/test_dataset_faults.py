"""Kills at random moments, full disks, and readers beside a writer: real processes, real files."""

import os
import random
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset
from physx_core.errors import DatasetError

WRITER = """
import sys
import numpy as np
from physx_core import Dataset

folder, seed, durable = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "durable"
random = np.random.default_rng(seed)
try:
    dataset = Dataset.open(folder, writable=True, max_file_size=2e-4, durable=durable)
except Exception:
    dataset = Dataset.create(folder, max_file_size=2e-4, durable=durable)
total = dataset.num_samples("training") if dataset.modes else 0
while True:
    count = int(random.integers(1, 400))
    rows = np.arange(total, total + count)
    values = np.sin(rows[:, None] * np.arange(1, 31))
    dataset.append("training", {"n": rows, "x": values, "y": values[:, 0].astype("float32")})
    total += count
    sys.stdout.write(f"{total}\\n")
    sys.stdout.flush()
"""


def expected(count):
    rows = np.arange(count)
    values = np.sin(rows[:, None] * np.arange(1, 31))
    return {"n": rows, "x": values, "y": values[:, 0].astype("float32")}


def write_and_kill(script, folder, seed, durable, seconds):
    """Run a writer, kill it after some seconds, and return how many rows it said to be stored."""
    arguments = [sys.executable, str(script), str(folder), str(seed), durable]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        first = process.stdout.readline()
        time.sleep(seconds)
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read()
    return int((first + rest).split(b"\n")[-2])


def check_after_kill(folder, committed):
    for path in folder.glob("run_*.h5"):
        with h5py.File(path) as file:
            assert 0 <= file["rows"][()] <= len(file["data"])
    with Dataset.open(folder) as dataset:
        total = dataset.num_samples("training")
        assert total >= committed
        rows = expected(total)
        for name, values in rows.items():
            assert_array_equal(dataset["training"][name][:], values)
        assert dataset.verify() == []
        mean = dataset.normalization["x"].mean
        np.testing.assert_allclose(mean, rows["x"].mean(axis=0), atol=1e-9)


def campaign(tmp_path, trials, seed):
    script = tmp_path / "writer.py"
    script.write_text(WRITER)
    chance = random.Random(seed)
    for trial in range(trials):
        folder = tmp_path / f"trial_{trial // 2}"  # the second kill hits an extended dataset
        durable = "durable" if trial % 4 == 3 else "fast"
        committed = write_and_kill(script, folder, trial, durable, chance.uniform(0.0, 0.1))
        check_after_kill(folder, committed)


def test_kill_9_loses_no_committed_row(tmp_path):
    campaign(tmp_path, 6, seed=1)


@pytest.mark.slow
def test_kill_9_loses_no_committed_row_in_many_trials(tmp_path):
    campaign(tmp_path, 60, seed=2)


def test_a_reader_beside_a_writer_sees_only_committed_rows(tmp_path):
    script, folder = tmp_path / "writer.py", tmp_path / "data"
    script.write_text(WRITER)
    arguments = [sys.executable, str(script), str(folder), "0", "fast"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as process:
        try:
            process.stdout.readline()
            with Dataset.open(folder) as dataset:
                seen, deadline = 0, time.monotonic() + 30
                while dataset.describe()[0]["partitions"] < 4 and time.monotonic() < deadline:
                    dataset.refresh()
                    total = dataset.num_samples("training")
                    assert total >= seen
                    for name, values in expected(total).items():
                        assert_array_equal(dataset["training"][name][seen:], values[seen:])
                    seen = total
                    os.read(process.stdout.fileno(), 2**16)
                assert dataset.describe()[0]["partitions"] >= 4
        finally:
            process.kill()


FILLER = """
import resource, sys
import numpy as np
from physx_core import Dataset
from physx_core.errors import DatasetError

folder, limit = sys.argv[1], int(sys.argv[2])
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
total = 0
try:
    with Dataset.create(folder, max_file_size=float(sys.argv[3])) as dataset:
        while total < 10**6:
            rows = np.arange(total, total + 100)
            dataset.append("training", {"n": rows, "x": np.sin(rows[:, None] * np.arange(1, 31))})
            total += 100
except DatasetError as error:
    print(total, error, sep="\\n")
"""


def check_full(tmp_path, folder, limit, file_size):
    script = tmp_path / "filler.py"
    script.write_text(FILLER)
    done = subprocess.run(
        [sys.executable, str(script), str(folder), str(limit), str(file_size)],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    total, message = done.stdout.split("\n", 1)
    assert "the disk is full" in message and "intact" in message
    return int(total)


def check_rows(folder, total):
    with Dataset.open(folder) as dataset:
        stored = dataset.num_samples("training") if dataset.modes else 0
        assert total <= stored < total + 100
        if stored:
            for name in ("n", "x"):
                assert_array_equal(dataset["training"][name][:], expected(stored)[name])
        assert dataset.verify() == []


@pytest.fixture
def small_disk(tmp_path):
    """An 8 MB disk."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(place)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no right to mount a small disk here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@pytest.mark.parametrize("file_size", [0.25, 0.0005])
def test_a_full_disk_loses_no_committed_row(tmp_path, small_disk, file_size):
    folder = small_disk / "data"
    total = check_full(tmp_path, folder, 0, file_size)
    assert total > 10000
    check_rows(folder, total)
    if file_size == 0.25:  # with space for the manifest, the writer goes on
        with pytest.raises(DatasetError):
            Dataset.open(folder, writable=True)
        check_rows(folder, total)


def test_a_file_size_limit_loses_no_committed_row(tmp_path):
    folder = tmp_path / "data"
    assert check_full(tmp_path, folder, 2**20, 0.25) == 0
    check_rows(folder, 0)
    assert not list(folder.glob("*_*.h5*"))


def test_a_full_disk_in_this_process_and_space_again(small_disk):
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(6 * 2**20))
    rows = expected(500)
    with Dataset.create(small_disk / "data") as dataset:
        stored = 0
        with pytest.raises(DatasetError, match=r"500 of 500 rows of mode 'training'"):
            while True:
                dataset.append("training", rows)
                stored += 500
        assert stored and dataset.num_samples("training") == stored
        ballast.unlink()
        dataset.append("training", rows)
        with pytest.raises(DatasetError):
            while True:
                dataset.append_sample("training", {name: rows[name][0] for name in rows})
        assert_array_equal(dataset["training"]["n"][: stored + 500][-500:], rows["n"])
    with Dataset.open(small_disk / "data") as dataset:
        assert dataset.num_samples("training") >= stored + 500
        assert_array_equal(dataset["training"]["x"][stored : stored + 500], rows["x"])
