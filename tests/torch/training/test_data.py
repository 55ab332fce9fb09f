from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import BatchSampler, DataLoader, RandomSampler

from physx_core import Dataset, Field
from physx_core.errors import DatasetError, DatasetNotFoundError
from physx_torch import StoredDataset

pytestmark = pytest.mark.processes

ROWS = 500


@pytest.fixture
def folder(tmp_path):
    """Rows whose x and y tell their number, in many partitions."""
    ids = np.arange(ROWS)
    with Dataset.create(tmp_path / "data", max_file_size=1.8e-5) as dataset:
        dataset.define_fields(
            "training", [Field("x", (2, 3)), Field("y", ()), Field("number", (), "int64")]
        )
        x = ids[:, None, None] + np.zeros((2, 3))
        dataset.append("training", {"x": x, "y": ids * 2.0, "number": ids})
        assert dataset.describe()[0]["partitions"] > 3
    return tmp_path / "data"


def check(batch):
    assert sorted(batch) == ["number", "x", "y"]
    assert batch["x"].shape[1:] == (2, 3) and batch["y"].ndim == 1
    torch.testing.assert_close(batch["y"], 2.0 * batch["number"].to(batch["y"].dtype))
    torch.testing.assert_close(batch["x"][:, 1, 2], batch["y"] / 2)


def test_single_samples(folder):
    samples = StoredDataset(folder)
    assert len(samples) == ROWS and samples.fields == ["x", "y", "number"]
    sample = samples[7]
    assert sample["x"].shape == (2, 3) and sample["x"].dtype == torch.float64
    assert sample["y"].shape == () and sample["number"].item() == 7
    assert samples[-1]["number"].item() == ROWS - 1
    for index in (ROWS, -ROWS - 1, [0, ROWS]):
        with pytest.raises(IndexError, match=f"there are {ROWS} samples"):
            samples[index]


@pytest.mark.parametrize("index", [[3, 499, 0], np.array([3, 499, 0]), torch.tensor([3, 499, 0])])
def test_several_samples(folder, index):
    batch = StoredDataset(folder)[index]
    check(batch)
    assert batch["number"].tolist() == [3, 499, 0]


def test_slices_fields_and_type(folder):
    batch = StoredDataset(folder, fields=["number", "x"], dtype="float32")[1:6:2]
    assert list(batch) == ["number", "x"] and batch["number"].tolist() == [1, 3, 5]
    assert batch["x"].dtype == torch.float32 and batch["number"].dtype == torch.int64


def test_a_session_folder_relative_to_another_place(folder, tmp_path, monkeypatch):
    folder.rename(tmp_path / "dataset")
    monkeypatch.chdir(tmp_path)
    samples = StoredDataset(".")
    monkeypatch.chdir("/")
    assert samples[3]["number"].item() == 3


@pytest.mark.parametrize(("workers", "method"), [(0, None), (2, "fork"), (1, "fork"), (2, "spawn")])
@pytest.mark.reported(
    "pytorch#11929",
    "pytorch#11887",
    "pytorch#1919",
    "torchmd-net#84",
    "datasets#5360",
    "datasets#6594",
    about="workers that share a file give errors, other samples' labels, or samples twice",
)
def test_loaders_give_every_sample_once(folder, workers, method):
    samples = StoredDataset(folder)
    samples[0]  # opened in this process already
    loader = DataLoader(
        samples,
        batch_size=32,
        shuffle=True,
        num_workers=workers,
        multiprocessing_context=method,
        persistent_workers=workers > 0,
    )
    for _ in range(2):
        batches = list(loader)
        for batch in batches:
            check(batch)
        assert [len(batch["y"]) for batch in batches] == [32] * 15 + [20]
        numbers = torch.cat([batch["number"] for batch in batches])
        assert numbers.tolist() != list(range(ROWS))
        assert sorted(numbers.tolist()) == list(range(ROWS))


@pytest.mark.parametrize("workers", [0, 2])
def test_whole_batches_at_once(folder, workers):
    samples = StoredDataset(folder)
    sampler = BatchSampler(RandomSampler(samples), 100, drop_last=False)
    batches = list(DataLoader(samples, batch_size=None, sampler=sampler, num_workers=workers))
    for batch in batches:
        check(batch)
    numbers = torch.cat([batch["number"] for batch in batches])
    assert sorted(numbers.tolist()) == list(range(ROWS))


def test_what_is_pickled_is_only_the_place(folder):
    samples = StoredDataset(folder)
    closed = len(pickle.dumps(samples))
    opened = len(list(Path("/proc/self/fd").iterdir()))
    samples[0]
    assert len(pickle.dumps(samples)) == closed < 1000
    assert len(list(Path("/proc/self/fd").iterdir())) == opened
    again = pickle.loads(pickle.dumps(samples))  # noqa: S301
    assert again[499]["number"].item() == 499


def test_what_is_missing(folder, tmp_path):
    with pytest.raises(DatasetNotFoundError):
        StoredDataset(tmp_path / "nothing")
    with pytest.raises(DatasetError, match="no mode"):
        StoredDataset(folder, "validation")
    with pytest.raises(DatasetError, match='no field "z"'):
        StoredDataset(folder, fields=["z"])
    path = folder / "run_training_x_1.h5"
    samples = StoredDataset(folder)
    samples[0]
    os.truncate(path, 1000)
    with pytest.raises(DatasetError, match="truncated"):
        samples[0]
