"""Creating, opening and closing: folders, locks, options, and a dataset's info."""

import fcntl
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.errors import (
    ConfigError,
    DatasetError,
    DatasetLockedError,
    DatasetNotFoundError,
    UsageError,
)

pytestmark = pytest.mark.processes

ROWS = {"x": np.ones((2, 3)), "n": np.array([1, 2], "int32")}


def test_creating_over_an_existing_dataset_is_an_error(dataset, folder):
    dataset.close()
    with pytest.raises(DatasetError, match="already"):
        Dataset.create(folder)


def test_a_session_folder_is_accepted(tmp_path):
    Dataset.create(tmp_path / "session" / "dataset").close()
    Dataset.open(tmp_path / "session").close()


def test_not_found_lists_what_is_there(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DatasetNotFoundError, match=r"notes\.txt"):
        Dataset.open(tmp_path)
    with pytest.raises(DatasetNotFoundError, match=r"does not exist.*notes\.txt"):
        Dataset.open(tmp_path / "missing")


LEAVES_A_COPY = """
import os, signal, sys
from physx_core import Dataset

dataset = Dataset.open(sys.argv[1], writable=True)
if os.fork():
    os.kill(os.getpid(), signal.SIGKILL)
print("copied", flush=True)
sys.stdin.readline()
"""


def test_the_copy_that_a_killed_writer_left_may_take_a_moment_to_end(dataset, folder):
    dataset.close()
    words = [sys.executable, "-c", LEAVES_A_COPY, folder]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as killed:
        assert killed.stdout.readline() == "copied\n"
        killed.wait()
        with (folder / "dataset.lock").open() as file, pytest.raises(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(DatasetLockedError, match=f"Process {killed.pid}"):
            Dataset.open(folder, writable=True)  # it stays
        threading.Timer(0.1, killed.stdin.close).start()
        Dataset.open(folder, writable=True).close()


@pytest.mark.reported("h5py#1804", about="a second writer damages the file")
def test_two_writers_are_rejected_and_readers_are_not(dataset, folder):
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
    dataset.append("training", ROWS)
    dataset.close()
    dataset.close()
    assert not dataset.writable
    with pytest.raises(UsageError, match="closed"):
        dataset.append("training", ROWS)
    with pytest.raises(UsageError, match="closed"):
        dataset["training"]
    with Dataset.open(folder) as reader:
        for write in (
            lambda: reader.append("training", ROWS),
            lambda: reader.append_sample("training", ROWS),
            lambda: reader.define_fields("training", [Field("x", (3,))]),
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


@pytest.mark.parametrize("durable", [False, True])
def test_an_exception_costs_neither_rows_nor_pending_samples(folder, durable):
    with pytest.raises(KeyboardInterrupt), Dataset.create(folder, durable=durable) as dataset:
        dataset.append("training", ROWS)
        dataset.append_sample("training", {"x": np.zeros(3), "n": 3})
        raise KeyboardInterrupt
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["n"][:], [1, 2, 3])
        assert dataset.verify() == []
