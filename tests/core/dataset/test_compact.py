"""Compaction of episodes: what goes, what stays, and what a process that dies leaves."""

import shutil

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field, View, files
from physx_core.dataset import EPISODES, EpisodeRecord, EpisodeStatus
from physx_core.errors import DatasetError, DatasetLockedError, UsageError

SIZE = (2**14 + 8 * 40) * 1e-9
MORE, FAILED = EpisodeStatus.MORE, EpisodeStatus.FAILED
MESH = Field("mesh", (2,), role="episode")


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


def store(dataset, episode, values, mass=None, **options):
    parameters = {"mass": float(episode if mass is None else mass)}
    has_ended = options.get("status") not in (FAILED, MORE)
    fields = {"mesh": [episode, len(values)]} if has_ended else {}
    record = EpisodeRecord(
        episode=episode, rows=len(values), parameters=parameters, fields=fields, seconds=0.5,
        **options,
    )  # fmt: skip
    rows = {"x": np.array(values, float)}
    dataset.append_episodes("training", rows, [record], episode_fields=[MESH])


def fill(dataset):
    """A stream, episodes in disorder, some failed, unfinished, replaced, or in several parts."""
    dataset.append("training", {"x": [-2.0, -1.0]})
    for episode in (3, 1, 0):
        store(dataset, episode, 100 * episode + np.arange(10 + episode))
    store(dataset, 2, [201.0, 202.0], status=MORE)
    store(dataset, 4, [401.0], status=MORE)
    store(dataset, 5, [], status=FAILED, reason="it exploded")
    store(dataset, 2, [203.0], part=1)
    store(dataset, 3, np.arange(300.0, 330.0), mass=-3)
    store(dataset, 4, [402.0], part=1, status=MORE)


def contents(dataset):
    known = dataset.recorded_episodes("training")
    table = {name: dataset[EPISODES][name][:] for name in ("episode", "mass", "seconds", "part")}
    masses = dict(zip(table["episode"].tolist(), table["mass"].tolist(), strict=True))
    return (
        dataset["training"]["x"][:].tolist(),
        [column.tolist() for column in known],
        [masses[episode] for episode in known.episode.tolist() if episode >= 0],
        dataset.episode_values("training", "mesh", slice(None)).tolist(),
        dataset.failed_episodes("training"),
        [array.tobytes() for array in dataset.normalization["x"].arrays().values()],
    )


def stored(dataset):
    return sum(row["bytes"] for row in dataset.describe()), sum(
        partition.rows for partition in dataset._manifest.modes["training"].partitions
    )


def test_only_rows_of_episodes_stay_and_in_order(folder):
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        fill(dataset)
    with Dataset.open(folder, writable=True, max_file_size=SIZE) as dataset:
        before = contents(dataset)
        assert stored(dataset)[1] == 2 + 13 + 11 + 10 + 2 + 1 + 1 + 30 + 1
        used = sum(path.stat().st_blocks for path in folder.iterdir()) * 512
        freed = dataset.compact()
        assert freed == used - sum(path.stat().st_blocks for path in folder.iterdir()) * 512
        assert contents(dataset) == before
        assert stored(dataset)[1] == len(before[0])
        assert dataset._reader.index("training") is None
        assert dataset.verify() == []
        assert dataset.num_samples(EPISODES) == len(before[1][0])
        assert dataset[EPISODES]["seconds"][:].sum() == 0.5 * 6  # both parts of 2; without 4
        files = sorted(path.name for path in folder.iterdir())
        assert dataset.compact() == 0
        assert sorted(path.name for path in folder.iterdir()) == files
    with Dataset.open(folder) as dataset:
        assert contents(dataset) == before
    with h5py.File(folder / "run.h5") as file:
        assert file["training/x"][:].tolist() == before[0]
    (folder / "dataset.json").unlink()
    Dataset.rebuild(folder)
    with Dataset.open(folder) as dataset:
        assert contents(dataset) == before


def test_rows_that_are_in_order_are_not_written_again(folder):
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        for episode in (1, 0, 3, 2):
            store(dataset, episode, 100 * episode + np.arange(30.0))
        dataset.compact()
        first = {path: path.stat().st_mtime_ns for path in folder.glob("*_training_x_*")}
        for episode in (5, 4):
            store(dataset, episode, 100 * episode + np.arange(30.0))
        before = contents(dataset)
        dataset.compact()
        assert contents(dataset) == before
        now = {path: path.stat().st_mtime_ns for path in folder.glob("*_training_x_*")}
        assert first.items() <= now.items()
    with Dataset.open(folder) as dataset:
        assert contents(dataset) == before
        assert dataset.verify() == []


def test_a_campaign_goes_on_after_compaction(folder):
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        fill(dataset)
        dataset.compact()
        with pytest.raises(UsageError, match="the next one is 0"):
            store(dataset, 4, [403.0], part=2)
        store(dataset, 4, [404.0])
        dataset.append("training", {"x": [9000.0]})
        rows = dataset["training"]["x"][:].tolist()
        assert rows[:2] == [-2, -1] and rows[-2:] == [404, 9000]
        dataset.compact()
        dataset.append("training", {"x": [9001.0]})
        assert dataset["training"]["x"][:].tolist() == [*rows, 9001]


def test_rows_of_streams_stay(folder):
    with Dataset.create(folder) as dataset:
        dataset.append("validation", {"x": [1.0, 2.0]})
        fill(dataset)
        before = (folder / "run_validation_x_0.h5").stat().st_ino
        dataset.compact("validation")
        assert stored(dataset)[1] > len(dataset["training"]["x"])
        dataset.compact()
        assert dataset["validation"]["x"][:].tolist() == [1, 2]
        assert (folder / "run_validation_x_0.h5").stat().st_ino == before


def test_who_may_not_compact(folder):
    with Dataset.create(folder) as dataset:
        fill(dataset)
        with pytest.raises(DatasetLockedError):
            Dataset.open(folder, writable=True)
        with pytest.raises(DatasetError, match="no mode"):
            dataset.compact("other")
    with Dataset.open(folder) as dataset, pytest.raises(UsageError, match="reading only"):
        dataset.compact()
    shared = Dataset.open(folder, writable=True, shared=True)
    with shared, pytest.raises(UsageError, match="sole writer"):
        shared.compact()


def test_open_batches_are_an_error_instead_of_other_rows(folder):
    with Dataset.create(folder) as dataset:
        fill(dataset)
        with View(hold_back=False).open(2, data=dataset) as batches:
            batches[0]
            dataset.compact()
            with pytest.raises(DatasetError, match="open them again"):
                batches[1]
            with pytest.raises(DatasetError, match="compacted"):
                View(hold_back=False).open(2, data=dataset, snapshot=batches.snapshot)


def test_a_reader_sees_the_same_rows_after_refreshing(folder):
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        fill(dataset)
    with Dataset.open(folder) as reader:
        before = contents(reader)
        with Dataset.open(folder, writable=True) as dataset:
            dataset.compact()
        reader.refresh()
        assert contents(reader) == before


def test_damaged_rows_are_not_copied(folder):
    with Dataset.create(folder) as dataset:
        fill(dataset)
    path = folder / "run_training_x_0.h5"
    content = bytearray(path.read_bytes())
    content[content.index(np.array([101.0]).tobytes())] ^= 1
    path.write_bytes(content)
    listing = sorted(folder.iterdir())
    dataset = Dataset.open(folder, writable=True)
    with pytest.raises(DatasetError, match="Nothing was compacted"):
        dataset.compact()
    dataset.close()
    assert sorted(folder.iterdir()) == listing


def test_rows_whose_records_are_lost_are_not_removed(folder):
    with Dataset.create(folder) as dataset:
        fill(dataset)
        dataset.update_info(lost_episodes=True)
        with pytest.raises(DatasetError, match="unknown which rows"):
            dataset.compact()


@pytest.mark.slow
@pytest.mark.parametrize("step", range(0, 90, 3))
def test_a_process_that_dies_while_compacting_leaves_all_rows(folder, monkeypatch, step):
    """After each operation on files, a copy of the folder is what a killed process leaves."""
    with Dataset.create(folder, max_file_size=SIZE) as dataset:
        fill(dataset)
        expected = contents(dataset)
    count, copy = 0, folder.with_name("killed")

    def counting(operation):
        def call(*arguments, **options):
            nonlocal count
            if count == step:
                shutil.copytree(folder, copy)
            count += 1
            return operation(*arguments, **options)

        return call

    options = {"writable": True, "max_file_size": SIZE}
    with Dataset.open(folder, **options) as dataset, monkeypatch.context() as patch:
        for name in ("write_at", "write_pieces", "rename", "remove", "replace"):
            patch.setattr(files, name, counting(getattr(files, name)))
        dataset.compact()
    assert count > 30
    if not copy.exists():
        return
    with Dataset.open(copy) as dataset:
        assert contents(dataset) == expected
    with Dataset.open(copy, writable=True, max_file_size=SIZE) as dataset:
        assert contents(dataset) == expected
        dataset.compact()
        assert contents(dataset) == expected
        assert dataset.verify() == []
        listed = {path.name for path in copy.glob("*_x_*")}
        partitions = dataset._manifest.modes["training"].partitions
        assert listed == {partition.file_name("x") for partition in partitions}
    assert_array_equal(len(expected[0]), stored(Dataset.open(copy))[1])
