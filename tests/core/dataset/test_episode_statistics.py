"""Statistics of modes with episodes: kept beside the rows, and always the same bits."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from physx_core import Dataset, Field, View
from physx_core.dataset import EpisodeRecord
from physx_core.dataset.read import ordered_statistics
from physx_core.dataset.read.reader import Reader


@pytest.fixture(autouse=True, params=[(4, 8), (6, 8)], ids=["long", "short"])
def cells(request, monkeypatch):
    """Rows of an episode that has statistics of its own, and of other rows that have."""
    monkeypatch.setattr(ordered_statistics, "_FEWEST", request.param[0])
    monkeypatch.setattr(ordered_statistics, "_MOST", request.param[1])
    return request.param[0] if request.param[0] > 5 else 5


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "data"


ROWS = np.random.default_rng(0).standard_normal((40, 5, 3)) + 100


def store(dataset, *episodes):
    for episode in episodes:
        record = EpisodeRecord(episode=episode, rows=5)
        dataset.append_episodes("training", {"x": ROWS[episode]}, [record])


def statistics(dataset):
    return [array.tobytes() for array in dataset.normalization["x"].arrays().values()]


@pytest.fixture
def rows_read(monkeypatch):
    """How many rows have been read."""
    count, read = [0], ordered_statistics._read

    def counted(known, of, cells):
        count[0] += int(cells.size.sum())
        return read(known, of, cells)

    monkeypatch.setattr(ordered_statistics, "_read", counted)
    return count


def test_whoever_opens_the_dataset_reads_no_rows(folder, rows_read, cells):
    with Dataset.create(folder) as dataset:
        store(dataset, *range(20, 0, -1))
        assert rows_read[0] == 0
        expected = statistics(dataset)
    rows_read[0] = 0
    with Dataset.open(folder) as dataset:
        assert statistics(dataset) == expected
        assert rows_read[0] == 0
    with Dataset.open(folder, writable=True) as dataset:
        store(dataset, *range(21, 31))
        rows_read[0] = 0
    assert rows_read[0] == (50 if cells == 5 else 150 - 96)
    rows_read[0] = 0
    with Dataset.open(folder) as dataset:
        now = statistics(dataset)
        assert rows_read[0] == 0
        dataset.recompute_normalization()
        assert rows_read[0] == 150
        assert statistics(dataset) == now
    next(folder.glob("order_*")).unlink()
    with Dataset.open(folder) as dataset:
        assert statistics(dataset) == now


def test_a_fold_of_long_episodes_reads_no_rows(folder, rows_read, cells):
    with Dataset.create(folder) as dataset:
        store(dataset, *range(20, 0, -1))
    for fold in range(5):
        rows_read[0] = 0
        view = View(fold=fold)
        with view.open(8, data=folder) as batches:
            found = batches.normalization()["x"]
            rows = batches.all_rows()
        assert (rows_read[0] == 0) == (cells == 5)
        with Dataset.open(folder) as dataset:
            x = dataset["training"]["x"][rows]
        assert_allclose(found.mean, x.mean(axis=0), rtol=1e-12)
        assert_allclose(found.std, x.std(axis=0), rtol=1e-12)
        assert_array_equal(found.minimum, x.min(axis=0))
        assert_array_equal(found.maximum, x.max(axis=0))


@pytest.mark.slow
def test_changed_rows_records_and_files_are_noticed(folder):
    with Dataset.create(folder) as dataset:
        store(dataset, *range(1, 10))

    def expected():
        reader = Dataset.open(folder)
        return [a.tobytes() for a in reader.recompute_normalization()["x"].arrays().values()]

    def check():
        with Dataset.open(folder) as dataset:
            assert statistics(dataset) == expected()

    def update(dataset):
        dataset.update("training", 3, {"x": [7.0, 7.0, 7.0]})

    def replace(dataset):
        record = EpisodeRecord(episode=4, rows=1)
        dataset.append_episodes("training", {"x": ROWS[30, :1]}, [record])

    changes = (
        update,
        replace,
        lambda dataset: store(dataset, 0),
        lambda dataset: store(dataset, 12),
        lambda dataset: dataset.remove_partition("training", 0),
        lambda dataset: dataset.compact(),
    )
    for change in changes:
        with Dataset.open(folder, writable=True) as dataset:
            statistics(dataset)
            change(dataset)
            if dataset.num_samples("training"):
                found = statistics(dataset)
        check()
        assert found == expected()
    path = next(folder.glob("order_*"))
    content = bytearray(path.read_bytes())
    content[-3] ^= 0xFF
    path.write_bytes(content)
    check()


@pytest.mark.slow
def test_what_is_extended_in_memory_has_the_same_bits(folder):
    random = np.random.default_rng(1)
    with Dataset.create(folder) as dataset:
        for episode in random.permutation(30).tolist():
            store(dataset, episode)
            found = statistics(dataset)
            with Dataset.open(folder) as reader:
                fresh = reader.recompute_normalization()["x"]
            assert found == [array.tobytes() for array in fresh.arrays().values()]


@pytest.mark.slow
def test_the_order_is_extended_as_if_it_were_read_anew(folder):
    """Also where records of ranges, parts, failures and replacements overlap."""
    random = np.random.default_rng(2)
    with Dataset.create(folder, max_file_size=(2**14 + 64 * 8) * 1e-9) as dataset:
        for _ in range(300):
            count = int(random.choice([1, 1, 2, 5]))
            first = int(random.integers(0, 60))
            campaign = int(random.integers(0, 2))
            record = EpisodeRecord(episode=first, rows=count, count=count, campaign=campaign)
            dataset.append_episodes("training", {"x": np.zeros((count, 1))}, [record])
            if random.random() < 0.05:
                dataset.append("training", {"x": np.ones((3, 1))})
            if random.random() < 0.5:
                found = dataset._reader.order("training")
                fresh = Reader(folder, dataset._manifest).order("training")
                for mine, other in zip(found.found, fresh.found, strict=True):
                    assert_array_equal(mine, other)
                rows = np.arange(found.rows)
                stored = rows if fresh.index is None else fresh.index
                assert_array_equal(found.stored(rows), stored)


def mesh(episode, rows=5):
    """The nodes of the rows of an episode; some rows have none, and some episodes."""
    sizes = np.arange(rows) * episode % 4
    return [100 + np.random.default_rng([episode, n]).normal(size=(n, 2)) for n in sizes]


def store_meshes(dataset, *episodes):
    for episode in episodes:
        record = EpisodeRecord(episode=episode, rows=5)
        dataset.append_episodes("training", {"x": mesh(episode)}, [record])


def test_entries_of_free_axes_are_read_once(folder, rows_read, cells):
    with Dataset.create(folder) as dataset:
        dataset.define_fields("training", [Field("x", ("node", 2))])
        store_meshes(dataset, *range(20, 0, -1))
        expected = statistics(dataset)
        rows_read[0] = 0
        assert statistics(dataset) == expected
        assert rows_read[0] == 0
    assert rows_read[0] == 0
    entries = np.concatenate([np.concatenate(mesh(episode)) for episode in range(1, 21)])
    with Dataset.open(folder) as dataset:
        assert statistics(dataset) == expected
        assert rows_read[0] == 0
        assert_allclose(dataset.normalization["x"].mean, entries.mean(axis=0), rtol=1e-12)
        assert_allclose(dataset.normalization["x"].std, entries.std(axis=0), rtol=1e-12)
        dataset.recompute_normalization()
        assert rows_read[0] == 100
        assert statistics(dataset) == expected
    with Dataset.open(folder, writable=True) as dataset:
        store_meshes(dataset, *range(21, 31))
        rows_read[0] = 0
    assert rows_read[0] == (50 if cells == 5 else 150 - 96)


def test_episodes_without_entries_have_no_part_in_statistics(folder, rows_read):
    with Dataset.create(folder) as dataset:
        dataset.define_fields("training", [Field("x", ("node", 2))])
        store_meshes(dataset, 4, 8)  # whose meshes are all empty
    with Dataset.open(folder, writable=True) as dataset:
        assert rows_read[0] == 10 and "x" not in dataset.normalization
        store_meshes(dataset, 5)
        expected = np.concatenate(mesh(5))
        assert_allclose(dataset.normalization["x"].mean, expected.mean(axis=0), rtol=1e-12)
        assert_array_equal(dataset.normalization["x"].minimum, expected.min(axis=0))
