"""Datasets that are open for writing while user code forks processes."""

import contextlib
import os

import numpy as np
import pytest

from physx_core import Dataset
from physx_core.errors import DatasetLockedError

pytestmark = pytest.mark.processes

ROWS = {"x": np.arange(6.0).reshape(3, 2)}


@contextlib.contextmanager
def forked(work=lambda: None):
    """Fork a process that does some work and then lives until the block ends; yields its id."""
    reading, writing = os.pipe()
    done_reading, done = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.close(writing)
            work()
            os.write(done, b"1")
            os.read(reading, 1)
        finally:
            os._exit(0)
    os.close(reading)
    os.close(done)
    try:
        assert os.read(done_reading, 1) == b"1", "the forked process failed"
        yield child
    finally:
        os.close(writing)
        os.close(done_reading)
        os.waitpid(child, 0)


@pytest.mark.parametrize("shared", [False, True])
def test_close_releases_the_lock_while_a_forked_process_still_runs(tmp_path, shared):
    dataset = Dataset.create(tmp_path, shared=shared)
    dataset.append("training", ROWS)
    with forked():
        dataset.close()
        with Dataset.open(tmp_path, writable=True) as again, forked():
            again.append("training", ROWS)
        assert Dataset.repair(tmp_path) == []
    assert Dataset.open(tmp_path).num_samples("training") == 6


def test_a_forked_process_that_exits_keeps_the_dataset_locked(tmp_path):
    with Dataset.create(tmp_path) as dataset:
        with forked():
            pass
        with pytest.raises(DatasetLockedError, match=str(os.getpid())):
            Dataset.open(tmp_path, writable=True)
        dataset.append("training", ROWS)


@pytest.mark.parametrize("durable", [False, True])
def test_a_forked_process_that_closes_the_dataset_stores_nothing_and_keeps_the_lock(
    tmp_path, durable
):
    with Dataset.create(tmp_path, durable=durable) as dataset:
        dataset.append("training", ROWS)
        dataset.append_sample("training", {"x": [6.0, 7.0]})
        with forked(dataset.close):
            with pytest.raises(DatasetLockedError):
                Dataset.open(tmp_path, writable=True)
            dataset.append_sample("training", {"x": [8.0, 9.0]})
    found = Dataset.open(tmp_path)
    np.testing.assert_array_equal(found["training"]["x"][:], np.arange(10.0).reshape(5, 2))
    assert found.verify() == []
