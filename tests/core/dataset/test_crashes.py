"""Kills at random moments, full disks, and readers beside a writer: real processes, real files."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from sizes import seed, trials

from physx_core import Dataset
from physx_core.errors import DatasetError, DatasetNotFoundError

pytestmark = pytest.mark.processes

KILLS = Path(__file__).parents[1] / "programs" / "dataset_kills.py"
WORKS = ["create", "append", "roll-over", "seal", "json", "update"]


def expected(count, first=0):
    rows = np.arange(first, first + count)
    values = np.sin(rows[:, None] * np.arange(1, 31))
    return {"n": rows, "x": values, "y": values[:, 0].astype("float32")}


# Kills ------------------------------------------------------------------------------------------


def kill(tmp_path, work, durability, seed, kills):
    """Kill writers, check what they leave, and return the counts."""
    arguments = [str(KILLS), str(tmp_path / "data"), work, durability, str(seed), str(kills)]
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    counts = json.loads(done.stdout.splitlines()[-1])
    assert counts["kills"] == kills
    return counts


@pytest.mark.parametrize("work", WORKS)
@pytest.mark.reported(
    "h5py#1807",
    "lerobot#3631",
    "lerobot#2529",
    "lerobot#2495",
    about="the file cannot be read after a crash; recorded episodes are lost",
)
def test_kill_9_loses_no_committed_row(tmp_path, work):
    kill(tmp_path, work, "durable" if work in ("append", "json") else "fast", 1, 2)


@pytest.mark.faults
@pytest.mark.parametrize("durability", ["fast", "durable"])
@pytest.mark.parametrize("work", WORKS)
def test_kill_9_campaign_loses_no_committed_row(
    tmp_path, record_property, work, durability
):  # 204 kills in a full campaign
    record_property("counts", kill(tmp_path, work, durability, seed(), trials(17, 6)))


# Readers beside a writer ------------------------------------------------------------------------

WRITER = """
import sys, time
import numpy as np
from physx_core import Dataset

random, total = np.random.default_rng(0), 0
with Dataset.create(sys.argv[1], max_file_size=4e-4) as dataset:
    while True:
        rows = np.arange(total, total + int(random.integers(1, 200)))
        values = np.sin(rows[:, None] * np.arange(1, 31))
        dataset.append("training", {"n": rows, "x": values, "y": values[:, 0].astype("float32")})
        total += len(rows)
        print(total, flush=True)
        time.sleep(0.001)
"""


def read_beside_a_writer(tmp_path, seconds):
    """Open and read a dataset, again and again, while it is written; return how often."""
    script, folder = tmp_path / "writer.py", tmp_path / "data"
    script.write_text(WRITER)
    arguments = [sys.executable, str(script), str(folder)]
    with (tmp_path / "told").open("wb") as told:
        process = subprocess.Popen(arguments, stdout=told)
    try:
        wait_for(lambda: (tmp_path / "told").stat().st_size)
        with Dataset.open(folder) as beside:
            begin, opened, seen, enough = time.monotonic(), 0, 0, False
            while (spent := time.monotonic() - begin) < seconds or not (enough or spent > 60):
                with Dataset.open(folder) as dataset:
                    seen = check_new_rows(dataset, seen)
                beside.refresh()
                assert beside.num_samples("training") >= seen
                check_new_rows(beside, seen)
                opened += 1 + open_in_h5py(folder)
                enough = opened > 10 and beside.describe()[0]["partitions"] > 4
        assert process.poll() is None
    finally:
        process.kill()
        process.wait()
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        assert dataset.describe()[0]["partitions"] > 4
    return opened


def wait_for(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def check_new_rows(dataset, seen):
    total = dataset.num_samples("training")
    assert total >= seen
    for name, values in expected(total - seen, seen).items():
        assert_array_equal(dataset["training"][name][seen:], values)
    some = np.random.default_rng(total).integers(0, total, 50)
    assert_array_equal(dataset["training"]["n"][some], some)
    return total


def open_in_h5py(folder):
    """Open the newest files as other tools do; return how many."""
    paths = sorted(folder.glob("*.h5"), key=lambda path: path.stat().st_mtime_ns)[-7:]
    for path in paths:
        with h5py.File(path) as file:
            if path.name == "run.h5":
                n = file["training/n"][-100:]
            else:
                count = int(file["rows"][()])
                n = file["data"][max(0, count - 100) : count] if "_n_" in path.name else []
            assert not len(n) or (np.diff(n) == 1).all()
    return len(paths)


def test_concurrent_reader_sees_only_committed_rows(tmp_path):
    assert read_beside_a_writer(tmp_path, 2) > 10


@pytest.mark.faults
def test_concurrent_reader_campaign_sees_only_committed_rows(tmp_path, record_property):
    record_property("opened", read_beside_a_writer(tmp_path, 8))


# Full disks -------------------------------------------------------------------------------------

FILLER = """
import resource, sys
import numpy as np
from physx_core import Dataset
from physx_core.errors import DatasetError, DatasetNotFoundError

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
    assert "the disk is full" in message
    safe = re.search(r"The (\d+) samples before them are intact", message)
    assert (int(safe[1]) if safe else 0) == int(total)
    return int(total)


def check_rows(folder, total):
    with Dataset.open(folder) as dataset:
        stored = dataset.num_samples("training")
        assert total <= stored < total + 100
        if stored:
            for name in ("n", "x"):
                assert_array_equal(dataset["training"][name][:], expected(stored)[name])
        assert dataset.verify() == []


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
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    with Dataset.open(folder, writable=True) as dataset:  # there is space: the next run goes on
        stored = dataset.num_samples("training")
        rows = expected(1000, stored)
        dataset.append("training", {name: rows[name] for name in ("n", "x")})
    check_rows(folder, stored + 1000)
    for path in folder.glob("run_*.h5"):
        with h5py.File(path) as file:
            assert file["rows"][()] == len(file["data"])


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
        what = r"500 of 500 rows of mode 'training' cannot be stored: the disk is full"
        with pytest.raises(DatasetError, match=what):
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


def fill_up(folder, free):
    """Fill a disk with so many bytes left in several ways; lose nothing."""
    ballast = folder.parent / "ballast"
    ballast.write_bytes(b"")
    left = os.statvfs(folder.parent)
    space = left.f_bavail * left.f_frsize
    ballast.write_bytes(bytes(max(0, space - free)))
    total, errors = 0, 0
    try:
        with Dataset.create(folder, max_file_size=5e-5) as dataset:
            for _ in range(3):
                for count in (1, 90, 170, 60) * 10:
                    try:
                        dataset.append("training", expected(count, total))
                        total += count
                    except DatasetError as error:
                        assert "the disk is full" in str(error)
                        errors += 1
                        total = dataset.num_samples("training")
            if total:
                dataset.update("training", 0, {"y": expected(1)["y"][0]})
    except DatasetError as error:
        assert "the disk is full" in str(error)
    try:
        with Dataset.open(folder) as dataset:
            total = check_all(dataset, total)
    except DatasetNotFoundError:
        assert not total
    ballast.unlink()
    exists = (folder / "dataset.json").exists()
    with Dataset.open(folder, writable=True) if exists else Dataset.create(folder) as dataset:
        dataset.append("training", expected(10, total))
    with Dataset.open(folder) as dataset:
        assert check_all(dataset, total + 10) == total + 10
        assert not list(folder.glob("*.tmp"))
    shutil.rmtree(folder)
    return errors


def check_all(dataset, least):
    total = dataset.num_samples("training")
    assert total >= least
    for name, values in expected(total).items() if total else ():
        assert_array_equal(dataset["training"][name][:], values)
    assert dataset.verify() == []
    return total


def test_disk_full_at_some_moments_loses_no_committed_row(small_disk):
    assert sum(fill_up(small_disk / "data", free) for free in (0, 30_000, 90_000, 400_000))


@pytest.mark.faults
def test_disk_full_at_every_moment_loses_no_committed_row(small_disk):
    for free in range(0, 1_200_000, 4096 * trials(9, 27)):
        fill_up(small_disk / "data", free)


# Few descriptors, and folders that go away ------------------------------------------------------

MANY_FILES = """
import resource, sys
import numpy as np
from physx_core import Dataset

resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
with Dataset.create(sys.argv[1], max_file_size=2.4e-5, durable=sys.argv[2] == "durable") as dataset:
    for first in range(0, 2000, 100):
        values = np.sin(np.arange(first, first + 100)[:, None] * np.arange(1, 10))
        dataset.append("training", {f"x{number}": values + number for number in range(8)})
"""


@pytest.mark.parametrize("durability", ["fast", "durable"])
def test_many_partitions_need_few_descriptors(tmp_path, durability):
    command = [sys.executable, "-c", MANY_FILES, str(tmp_path / "data"), durability]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with Dataset.open(tmp_path / "data") as dataset:
        assert dataset.num_samples("training") == 2000
        values = np.sin(np.arange(2000)[:, None] * np.arange(1, 10))
        assert_array_equal(dataset["training"]["x3"][:], values + 3)
        assert 8 * dataset.describe()[0]["partitions"] > 2 * 64


@pytest.mark.parametrize("durable", [False, True])
def test_removed_dataset_folder_is_an_error(tmp_path, durable):
    folder = tmp_path / "session" / "dataset"
    dataset = Dataset.create(folder, durable=durable)
    dataset.append("training", expected(10))
    shutil.rmtree(tmp_path / "session")
    begin = time.monotonic()
    with pytest.raises(DatasetError, match="removed"):
        while time.monotonic() < begin + 20:  # two passes of the syncer take about two seconds
            dataset.append("training", expected(10))
            time.sleep(0.01)
    with pytest.raises(DatasetError):
        dataset.append("training", expected(10))
    with pytest.raises(DatasetError):
        dataset.close()
