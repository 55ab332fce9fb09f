"""The table of episodes: what commits rows, who sees which, and what survives."""

import os
import shutil

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, Field
from physx_core.dataset import EPISODES, EpisodeRecord, EpisodeStatus, FailedEpisode, Progress
from physx_core.dataset.read import virtual_index
from physx_core.dataset.store import locks
from physx_core.dataset.store.episode_record import OPEN
from physx_core.errors import (
    ConfigError,
    DatasetError,
    FieldShapeError,
    FieldsMismatchError,
    FieldTypeError,
    MissingFieldError,
    NotFiniteError,
    UnknownFieldError,
    UsageError,
)

FAILED, MORE = EpisodeStatus.FAILED, EpisodeStatus.MORE


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


def x(*values):
    return {"x": np.array(values, np.float64)}


def store(dataset, episode, *values, **options):
    record = EpisodeRecord(episode=episode, rows=len(values), **options)
    dataset.append_episodes("training", x(*values), [record])


def read(dataset):
    return dataset["training"]["x"][:].tolist()


# Committing -------------------------------------------------------------------------------------


def test_rows_whose_record_is_missing_do_not_exist(folder, monkeypatch):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1, 2)
        writer = dataset._appender.writer
        append = writer.append

        def fail(mode, rows, count):
            if mode == EPISODES:
                raise DatasetError("the disk is full")
            append(mode, rows, count)

        monkeypatch.setattr(writer, "append", fail)
        with pytest.raises(DatasetError):
            store(dataset, 1, 3, 4)
        monkeypatch.undo()
        assert read(dataset) == [1, 2]
    with Dataset.open(folder, writable=True) as dataset:
        assert read(dataset) == [1, 2]
        assert dataset.describe()[0]["samples"] == 2
        store(dataset, 1, 5)
        assert read(dataset) == [1, 2, 5]
    with h5py.File(folder / "run.h5") as file:
        assert_array_equal(file["training/x"][:], [1, 2, 5])


def test_a_later_record_replaces_an_earlier_one_once_it_is_complete(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1, status=EpisodeStatus.CUT)
        store(dataset, 1, status=FAILED, reason="it exploded")
        store(dataset, 0, 2, status=MORE)
        assert read(dataset) == [1]
        store(dataset, 0, 3, part=1)
        assert read(dataset) == [2, 3]
        assert dataset.failed_episodes("training") == [
            FailedEpisode("training", 0, 1, "it exploded"),
        ]
        store(dataset, 1, 4)
        assert read(dataset) == [2, 3, 4]
        assert dataset.failed_episodes("training") == []


def test_parameters_are_columns_of_the_table(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 3, 1, 2, parameters={"mass": 2.5, "at": [1.0, 2.0]}, seconds=0.5)
        for wrong, parameters in (
            (MissingFieldError, {"mass": 1.0}),
            (UnknownFieldError, {"mass": 1.0, "at": [1.0, 2.0], "k": 1.0}),
            (NotFiniteError, {"mass": np.nan, "at": [1.0, 2.0]}),
        ):
            with pytest.raises(wrong):
                store(dataset, 4, 3, parameters=parameters)
        assert read(dataset) == [1, 2]
        where = dataset[EPISODES]["episode"][:] == 3
        assert dataset[EPISODES]["mass"][:][where].tolist() == [2.5]
        assert dataset[EPISODES]["seconds"][:][where].tolist() == [0.5]


def test_no_episodes_do_not_decide_which_parameters_all_have(folder):
    with Dataset.create(folder) as dataset:
        dataset.append_episodes("training", {}, [])
        assert EPISODES not in dataset
        with pytest.raises(ConfigError):
            dataset.append_episodes("other", {}, [])
        store(dataset, 0, 1, parameters={"mass": 1.0})


def test_a_wrong_call_stores_nothing(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1)
        for wrong, call in (
            (UsageError, lambda: store(dataset, 1, 2, part=1)),
            (ConfigError, lambda: store(dataset, -1, 2)),
            (ConfigError, lambda: store(dataset, 1, 2, status=FAILED)),
            (ConfigError, lambda: store(dataset, 1, 2, count=2)),
            (ConfigError, lambda: store(dataset, 1, 2, status=EpisodeStatus.STREAM)),
            (ConfigError, lambda: dataset.append_episodes("other", x(1), [])),
            (UsageError, lambda: dataset.append_episodes("training", x(1), [])),
            (NotFiniteError, lambda: store(dataset, 1, np.nan)),
            (UsageError, lambda: dataset.remove_partition(EPISODES, 0)),
        ):
            with pytest.raises(wrong):
                call()
        assert read(dataset) == [1]


def test_a_mode_that_happens_to_be_called_episodes_is_an_ordinary_one(folder):
    with Dataset.create(folder) as dataset:
        dataset.append(EPISODES, x(1, 2))
        dataset.append("training", x(3))
        assert read(dataset) == [3]
        with pytest.raises(FieldsMismatchError):
            store(dataset, 0, 1)


def test_several_writers_cannot_store_episodes(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1)
    with Dataset.open(folder, writable=True, shared=True) as dataset:
        with pytest.raises(UsageError):
            store(dataset, 1, 2)
        with pytest.raises(UsageError):
            dataset.append("training", x(1))
        assert read(dataset) == [1]


def test_rows_around_damaged_ones_stay_those_of_their_episodes(folder):
    with Dataset.create(folder, max_file_size=(2**14 + 8 * 3000) * 1e-9) as dataset:
        for episode in (2, 1, 0):
            store(dataset, episode, *(1000 * episode + np.arange(500.0)))
        copy = folder.with_name("killed")
        shutil.copytree(folder, copy)
    path = copy / "run_training_x_0.h5"
    content = path.read_bytes()
    place = content.index(np.arange(1200.0, 1210.0).tobytes())
    path.write_bytes(content[:place] + bytes(80) + content[place + 80 :])
    with pytest.warns(UserWarning, match="damaged"):
        Dataset.repair(copy)
    with Dataset.open(copy, writable=True) as dataset:
        assert read(dataset) == [*range(500), *range(2000, 2500)]
        store(dataset, 1, 1)
        assert read(dataset) == [*range(500), 1, *range(2000, 2500)]


# Beside a writer --------------------------------------------------------------------------------


def test_asking_for_a_writer_changes_nothing_and_stops_none(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "dataset.lock").unlink()
    Dataset.open(folder).close()
    assert {path.name for path in folder.iterdir()} == before.keys() - {"dataset.lock"}
    Dataset.open(folder, writable=True).close()


# The same rows, wherever they are stored --------------------------------------------------------


@pytest.mark.slow
def test_statistics_are_bit_equal_for_any_order_and_any_partitions(tmp_path):
    random = np.random.default_rng(0)
    lengths = random.integers(1, 90, 300)
    rows = random.standard_normal((lengths.sum(), 7)) + 3
    ends = np.cumsum(lengths)
    orders = np.arange(300), random.permutation(300), np.arange(300)[::-1]
    found = []
    for number, (order, size) in enumerate(zip(orders, (1e-3, 1e-4, 3e-5), strict=True)):
        with Dataset.create(tmp_path / f"{number}", max_file_size=size) as dataset:
            for episode in order:
                block = rows[ends[episode] - lengths[episode] : ends[episode]]
                record = EpisodeRecord(episode=int(episode), rows=len(block))
                dataset.append_episodes("training", {"x": block}, [record])
        with Dataset.open(tmp_path / f"{number}") as dataset:
            assert_array_equal(dataset["training"]["x"][:], rows)
            found.append(dataset.normalization["x"])
    for other in found[1:]:
        assert_array_equal(other.mean, found[0].mean)
        assert_array_equal(other.std, found[0].std)


def test_episodes_that_come_in_order_need_no_index(folder):
    with Dataset.create(folder) as dataset:
        for episode in range(5):
            store(dataset, episode, episode, episode + 0.5)
        assert dataset._reader.index("training") is None
        store(dataset, 6, 6)
        store(dataset, 5, 5)
        assert dataset._reader.index("training").tolist() == [*range(10), 11, 10]


def test_ranges_of_episodes_with_one_row_cost_one_record(folder):
    with Dataset.create(folder) as dataset:
        for first in (200, 0, 100):
            store(dataset, first, *range(first, first + 100), count=100)
        store(dataset, 150, -1)
        assert dataset.num_samples(EPISODES) == 5  # with that of the stream before them
        assert read(dataset) == [*range(150), -1, *range(151, 300)]
        assert len(dataset.episodes("training")) == 300


# Files ------------------------------------------------------------------------------------------


def test_ranges_with_parameters_have_a_row_of_the_table_for_each_number(folder):
    with Dataset.create(folder) as dataset:
        values = {"mass": np.arange(3.0), "at": np.arange(6.0).reshape(3, 2)}
        store(dataset, 5, 1, 2, 3, count=3, parameters=values, seconds=0.75)
        store(dataset, 2, 4, parameters={"mass": 9.0, "at": [1.0, 2.0]}, seconds=0.5)
        for wrong in (np.zeros(2), 1.0):
            with pytest.raises(ConfigError):
                store(dataset, 8, 5, 6, 7, count=3, parameters={**values, "mass": wrong})
    with Dataset.open(folder) as dataset:
        table = dataset[EPISODES]
        found = {name: table[name][1:].tolist() for name in table}  # the first is of the stream
        assert dataset["training"]["x"][:].tolist() == [4, 1, 2, 3]
    assert found["episode"] == [5, 6, 7, 2]
    assert found["count"] == found["rows"] == [1] * 4
    assert found["first_row"] == [0, 1, 2, 3]
    assert found["seconds"] == [0.25, 0.25, 0.25, 0.5]
    assert found["mass"] == [0, 1, 2, 9]
    assert found["at"] == [[0, 1], [2, 3], [4, 5], [1, 2]]


def test_a_torn_reason_costs_only_itself(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, status=FAILED, reason="first\nline")
        store(dataset, 1, status=FAILED, reason="second")
    path = folder / "failures.jsonl"
    os.truncate(path, path.stat().st_size - 5)
    with Dataset.open(folder, writable=True) as dataset:
        store(dataset, 2, status=FAILED, reason="third")
        dataset.append("training", x(1))
        found = dataset.failed_episodes("training")
        assert [f.reason for f in found] == ["first\nline", "", "third"]
        assert dataset.verify() == []
    path.unlink()
    with Dataset.open(folder) as dataset:
        assert [f.episode for f in dataset.failed_episodes("training")] == [0, 1, 2]


@pytest.mark.slow
def test_merged_campaigns_keep_their_rows_and_reasons(tmp_path):
    for name in "ab":
        with Dataset.create(tmp_path / name) as dataset:
            store(dataset, 1, ord(name))
            store(dataset, 0, status=FAILED, reason=name)
    with Dataset.open(tmp_path / "a", writable=True) as dataset:
        dataset.merge(tmp_path / "b")
        assert read(dataset) == [ord("a"), ord("b")]
        store(dataset, 2, 1, campaign=0)
        assert read(dataset) == [ord("a"), 1, ord("b")]
        assert dataset.failed_episodes("training") == [
            FailedEpisode("training", 0, 0, "a"),
            FailedEpisode("training", 1, 0, "b"),
        ]


def test_rebuilding_keeps_the_order(folder):
    with Dataset.create(folder, max_file_size=(2**14 + 40) * 1e-9) as dataset:
        dataset.append("training", x(*range(7)))
        for episode in (3, 1, 0, 2):
            store(dataset, episode, *[10 * episode + k for k in range(episode + 1)])
        dataset.remove_partition("training", 0)
        expected = read(dataset)
    assert expected == [5, 6, 0, 10, 11, 20, 21, 22, 30, 31, 32, 33]
    (folder / "dataset.json").unlink()
    Dataset.rebuild(folder)
    with Dataset.open(folder) as dataset:
        assert read(dataset) == expected


def test_contents_change_with_the_records(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 1, 1)
        store(dataset, 0, 2)
    with Dataset.open(folder, writable=True) as dataset:
        before = dataset.contents("training")
        store(dataset, 1, status=FAILED)
    with Dataset.open(folder) as dataset:
        assert dataset.contents("training") != before


def test_contents_do_not_count_records_as_rows(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1, 2)
        store(dataset, 1, 3)
    with Dataset.open(folder) as dataset:
        found = dataset.contents("training")
        assert sum(rows for _, _, rows, _ in found) == 3
        assert len({(session, index) for session, index, _, _ in found}) == len(found)


def test_progress_counts_how_episodes_ended(folder, monkeypatch):
    with Dataset.create(folder) as dataset:
        dataset.append("training", x(1))
        assert dataset.progress("training") == []
        for episode in (0, 2, 3):
            store(dataset, episode, episode, seconds=2.0)
        store(dataset, 4, status=FAILED, seconds=1.0)
        store(dataset, 5, 5, status=EpisodeStatus.CUT, seconds=0.5)
        store(dataset, 6, 6, status=MORE, seconds=4.0)
        store(dataset, 3, 3, status=MORE, seconds=4.0)
        store(dataset, 3, 3, part=1, seconds=4.0)
        store(dataset, 0, *range(9), count=9, campaign=3, seconds=18.0)
        expected = [
            Progress(campaign=0, finished=3, failed=1, cut=1, unfinished=1, seconds=13.5),
            Progress(campaign=3, finished=9, failed=0, cut=0, unfinished=0, seconds=18.0),
        ]
        assert dataset.progress("training") == expected
        monkeypatch.setattr(locks, "is_written", lambda folder: True)
        with Dataset.open(folder) as reader:
            assert reader.progress("training") == expected  # also after the missing number 1
            assert reader.num_samples("training") == 2
            assert reader.is_written
        assert not dataset.is_written
    assert expected[0].mean == 2.7


@pytest.mark.parametrize("seed", range(20))
def test_a_hostile_table_is_read_or_refused(folder, seed, monkeypatch):
    monkeypatch.setattr(Dataset, "_check_ordinary", lambda *_: None)  # it was written elsewhere
    random = np.random.default_rng(seed)
    with Dataset.create(folder) as dataset:
        store(dataset, 0, 1, 2, 3)
        names = ("campaign", "episode", "count", "first_row", "rows", "part")
        few = [-(2**63), -1, 0, 0, 0, 1, 1, 2, 3, OPEN, 2**62, 2**63 - 1]
        table = {name: random.choice(few, 30).astype(np.int64) for name in names}
        table["mode_index"] = random.integers(-1, 4, 30, np.int8)
        table["status"] = random.integers(-1, 7, 30, np.int8)
        table["seconds"] = np.zeros(30)
        dataset.append(EPISODES, table)
    with Dataset.open(folder) as dataset:
        try:
            found = read(dataset)
        except DatasetError as error:
            assert "episodes share rows" in str(error)
        else:
            assert len(found) <= 3 and set(found) <= {1, 2, 3}


def test_the_virtual_index_says_that_rows_lie_in_too_many_pieces(folder, monkeypatch):
    monkeypatch.setattr(virtual_index, "_MOST_PIECES", 2)
    with Dataset.create(folder) as dataset:
        for episode in (2, 1, 0):
            store(dataset, episode, episode)
    with h5py.File(folder / "run.h5") as file:
        assert not list(file["training"]) and file["training"].attrs["pieces"] == 3
        assert file[EPISODES]["episode"][:].tolist() == [-1, 2, 1, 0]


# Fields of episodes -----------------------------------------------------------------------------

MESH = [
    Field("mesh", (2,), "float32", "m", role="episode"),
    Field("sets", (), "int8", role="episode"),
]


def meshed(dataset, episode, *values, fields=None, **options):
    fields = {"mesh": [episode, -1], "sets": episode} if fields is None else fields
    record = EpisodeRecord(episode=episode, rows=len(values), fields=fields, **options)
    dataset.append_episodes("training", x(*values), [record], episode_fields=MESH)


def test_fields_that_an_episode_has_once_are_found_by_row(folder):
    with Dataset.create(folder) as dataset:
        dataset.append("training", x(-1))
        meshed(dataset, 2, 20, 21)
        meshed(dataset, 0, fields={}, status=FAILED)
        meshed(dataset, 1, 10, fields={}, status=MORE)
        meshed(dataset, 3)
        meshed(dataset, 1, 11, 12, part=1)
        expected = [0, 1, 1, 1, 2, 2]
        assert dataset.episode_values("training", "sets", slice(None)).tolist() == expected
        found = dataset.episode_values("training", "mesh", [5, 0, -3])
        assert (found.tolist(), found.dtype) == ([[2, -1], [0, 0], [1, -1]], np.float32)
        assert dataset.episode_values("training", "mesh", []).shape == (0, 2)
        with pytest.raises(IndexError):
            dataset.episode_values("training", "mesh", [6])
    Dataset.rebuild(folder)
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        assert [dataset.fields(EPISODES)[field.name] for field in MESH] == MESH
        assert dataset.episode_values("training", "sets", slice(None)).tolist() == expected


def test_fields_that_an_episode_has_once_are_checked(folder):
    with Dataset.create(folder) as dataset:
        meshed(dataset, 0, 1)
        for error, fields in [
            (MissingFieldError, {"mesh": [0, 0]}),
            (UnknownFieldError, {"mesh": [0, 0], "sets": 0, "more": 0}),
            (FieldShapeError, {"mesh": [0, 0, 0], "sets": 0}),
            (FieldTypeError, {"mesh": [0, 0], "sets": 1000}),
            (NotFiniteError, {"mesh": [0, np.inf], "sets": 0}),
        ]:
            with pytest.raises(error):
                meshed(dataset, 1, 2, fields=fields)
        with pytest.raises(ConfigError, match="no such episode"):
            meshed(dataset, 1, 2, 3, count=2)
        meshed(dataset, 1, 2, 3, count=2, fields={})
        assert read(dataset) == [1, 2, 3]
        assert dataset.episode_values("training", "sets", slice(None)).tolist() == [0, 0, 0]


def test_values_of_episodes_need_episodes(folder):
    with Dataset.create(folder) as dataset:
        dataset.append("training", x(1))
        with pytest.raises(DatasetError, match="no recorded episodes"):
            dataset.episode_values("training", "mesh", [0])
        with pytest.raises(DatasetError):
            dataset.episode_values("validation", "mesh", [0])
