"""Several processes write to one dataset at the same time."""

import json
import shutil
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from sizes import trials

from physx_core import Dataset, Field
from physx_core.errors import DatasetLockedError, FieldsMismatchError, UsageError

pytestmark = pytest.mark.processes

WRITER = """
import sys
import numpy as np
from physx_core import Dataset

folder, number, total, size = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
session = sys.argv[5] if len(sys.argv) > 5 else None
random = np.random.default_rng(number)
with Dataset.open(
    folder, writable=True, shared=True, session=session, max_file_size=size
) as dataset:
    done = 0
    while done < total:
        rows = np.arange(done, min(total, done + int(random.integers(1, 500))))
        values = np.sin(rows[:, None] + number * np.arange(1, 6))
        dataset.append("training", {"who": np.full(len(rows), number), "n": rows, "x": values})
        done += len(rows)
        print(done, flush=True)
"""


def start(tmp_path, folder, number, total, size=2e-4, *session):
    script = tmp_path / "writer.py"
    script.write_text(WRITER)
    arguments = map(str, (script, folder, number, total, size, *session))
    return subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE)


def check(folder, totals):
    """Check that each writer's rows are there in their order; return how many of each."""
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        view = dataset["training"]
        who, n, x = view["who"][:], view["n"][:], view["x"][:]
        mean = dataset.normalization["x"].mean
        np.testing.assert_allclose(mean, x.mean(axis=0), atol=1e-9)
    found = []
    for number, total in enumerate(totals):
        mine = who == number
        assert mine.sum() >= total
        assert_array_equal(n[mine], np.arange(mine.sum()))
        expected = np.sin(n[mine][:, None] + number * np.arange(1, 6))
        assert_array_equal(x[mine], expected)
        found.append(int(mine.sum()))
    assert sum(found) == len(who)
    return found


def partitions(folder):
    plain = json.loads((folder / "dataset.json").read_text())
    return plain["modes"]["training"]["partitions"]


COUNT = trials(100_000, 20_000)


@pytest.mark.parametrize("sessions", [(), ("a", "b")])
@pytest.mark.reported("h5py#1804", about="several processes write one dataset")
def test_concurrent_writers_lose_no_rows(tmp_path, folder, sessions):
    Dataset.create(folder).close()
    writers = [
        start(tmp_path, folder, number, COUNT, 5e-4, *sessions[number : number + 1])
        for number in range(2)
    ]
    seen = 0
    while any(writer.poll() is None for writer in writers):
        with Dataset.open(folder) as reader:
            count = reader.num_samples("training")
            assert count >= seen
            seen = count
            if count:
                who, n = reader["training"]["who"][:], reader["training"]["n"][:]
                for number in range(2):
                    assert_array_equal(n[who == number], np.arange((who == number).sum()))
    for writer in writers:
        writer.communicate()
        assert writer.returncode == 0
    assert check(folder, [COUNT, COUNT]) == [COUNT, COUNT]
    found = partitions(folder)
    assert all(partition["sealed"] and partition["counted"] for partition in found)
    assert len({(partition["session"], partition["index"]) for partition in found}) == len(found)
    first_rows = [partition["first_row"] for partition in found]
    assert first_rows == sorted(first_rows)
    with Dataset.open(folder) as dataset:
        before = dataset["training"]["n"][:]
    for session in {partition["session"] for partition in found}:
        with h5py.File(folder / f"{session}.h5") as file:
            assert_array_equal(np.sort(file["training/n"][:]), np.sort(before))
    Dataset.rebuild(folder)  # the order of rows is in the files, too
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["n"][:], before)


@pytest.mark.parametrize("victims", [1, 3])
def test_killed_writer_does_not_block_concurrent_writers(tmp_path, folder, victims):
    Dataset.create(folder).close()
    writers = [start(tmp_path, folder, number, 10**9) for number in range(3)]
    totals = [0, 0, 0]
    for number, writer in enumerate(writers):
        for _ in range(30):
            totals[number] = int(writer.stdout.readline())
    for number in range(victims):
        writers[number].send_signal(signal.SIGKILL)
        totals[number] = int((b"0\n" + writers[number].communicate()[0]).split(b"\n")[-2]) or 1
    for number in range(victims, 3):
        for _ in range(100):
            totals[number] = int(writers[number].stdout.readline())
    check(folder, totals)
    for writer in writers[victims:]:
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    before = check(folder, totals)
    with Dataset.open(folder, writable=True) as dataset:
        assert dataset.num_samples("training") == sum(before)
    assert check(folder, totals) == before
    assert all(partition["sealed"] for partition in partitions(folder))


def rows(number, count):
    return {"x": np.full((count, 2), float(number)), "n": np.arange(count)}


def test_writers_see_each_other_when_they_refresh(folder):
    with Dataset.create(folder, shared=True) as one:
        one.append("training", rows(1, 3))
        with Dataset.open(folder, writable=True, shared=True) as two:
            two.append("training", rows(2, 4))
            next(one.batches("training", 5))
            one.append("training", rows(1, 1))
            one.refresh()
            assert_array_equal(one["training"]["x"][:][:, 0], [1] * 4 + [2] * 4)
            two.append("validation", rows(2, 1))
            two.refresh()
            assert_array_equal(two["training"]["x"][:][:, 0], [1] * 4 + [2] * 4)
            assert_array_equal(next(two.batches("training", 9))["x"][:, 0], [1] * 4 + [2] * 4)
            one.append("validation", rows(1, 2))
            one.update_info(a=1)
            two.update_info(b=2)
        one.append("training", rows(1, 2))
        assert_array_equal(next(one.batches("training", 20))["x"][:, 0], [1] * 6 + [2] * 4)
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["x"][:][:, 0], [1] * 6 + [2] * 4)
        assert_array_equal(dataset["validation"]["n"], [0, 0, 1])
        assert dataset.info == {"a": 1, "b": 2}
        assert dataset.verify() == []


def test_fields_of_all_writers_are_the_same(folder):
    with (
        Dataset.create(folder, shared=True) as one,
        Dataset.open(folder, writable=True, shared=True) as two,
    ):
        one.define_fields("training", [Field("x", (2,))])
        with pytest.raises(FieldsMismatchError):
            two.append("training", rows(2, 3))
        two.append("training", {"x": np.ones((3, 2))})
        with pytest.raises(FieldsMismatchError):
            two.define_fields("training", [Field("x", (3,))])
        one.append("training", {"x": np.zeros((3, 2))})
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["x"][:][:, 0], [1, 1, 1, 0, 0, 0])


def test_shared_and_exclusive_writers_exclude_each_other(folder):
    with Dataset.create(folder) as one:
        for shared in (False, True):
            with pytest.raises(DatasetLockedError, match="shared=True"):
                Dataset.open(folder, writable=True, shared=shared)
        one.append("training", rows(1, 2))
    with Dataset.open(folder, writable=True, shared=True) as one:
        with Dataset.open(folder, writable=True, shared=True):
            with pytest.raises(DatasetLockedError):
                Dataset.open(folder, writable=True)
            with pytest.raises(DatasetLockedError):
                Dataset.repair(folder)
        for change in (
            lambda: one.update("training", 0, {"n": 5}),
            lambda: one.remove_partition("training", 0),
        ):
            with pytest.raises(UsageError, match="without shared"):
                change()
    Dataset.open(folder, writable=True).close()


def test_shared_writer_seals_partitions_of_killed_writer(folder, tmp_path):
    with Dataset.create(folder, shared=True) as one:
        one.append("training", rows(1, 3))
        shutil.copytree(folder, tmp_path / "killed")
    with Dataset.open(tmp_path / "killed", writable=True, shared=True) as dataset:
        dataset.append("training", rows(2, 2))
    with Dataset.open(tmp_path / "killed") as dataset:
        assert_array_equal(dataset["training"]["x"][:][:, 0], [1, 1, 1, 2, 2])
    assert all(partition["sealed"] for partition in partitions(tmp_path / "killed"))
