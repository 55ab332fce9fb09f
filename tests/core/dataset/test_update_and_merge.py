"""Updating datasets in place, merging them and removing partitions."""

import json
import shutil
import zlib

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from safetensors.numpy import load_file, save

from physx_core import Dataset
from physx_core.errors import (
    DatasetError,
    DatasetNotFoundError,
    FieldsMismatchError,
    NotFiniteError,
    SampleError,
    UsageError,
)

N = 1000


# Updating ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "index", [3, -1, slice(300, 700), slice(None, None, 7), [5, 999, 340, 4], np.arange(N) % 9 == 0]
)
def test_updated_rows_are_read_at_once_and_later(folder, index, thousand):
    thousand.write(folder)
    rows = {name: values.copy() for name, values in thousand.rows.items()}
    rows["x"][index] = -rows["x"][index]
    rows["n"][index] = 7
    with Dataset.open(folder, writable=True, max_file_size=thousand.size) as dataset:
        next(dataset.batches("training", 10))  # rows in memory are read anew
        before = dataset.normalization["x"].mean
        dataset.update("training", index, {"x": rows["x"][index], "n": rows["n"][index]})
        assert_array_equal(dataset["training"]["x"][:], rows["x"])
        assert_array_equal(next(dataset.batches("training", N))["n"], rows["n"])
        assert not np.array_equal(dataset.normalization["x"].mean, before)
        assert dataset.verify() == []
    thousand.check(folder, rows)


def test_rows_of_the_open_partition_are_updated_too(folder, thousand):
    rows = thousand.stacked(thousand.rows, thousand.rows)
    with Dataset.create(folder, max_file_size=thousand.size) as dataset:
        dataset.append("training", thousand.rows)
        assert dataset.normalization["x"].mean.shape == (5,)
        for start in range(900, 1000, 25):
            where = slice(start, start + 25)
            rows["x"][where] *= 2
            dataset.update("training", where, {"x": rows["x"][where]})
        with Dataset.open(folder) as reader:
            assert_array_equal(reader["training"]["x"][:], rows["x"][:N])
        dataset.append("training", thousand.rows)
    with Dataset.open(folder, writable=True) as dataset:
        dataset.update("training", [], {"x": np.zeros((0, 5))})
        assert_array_equal(dataset["training"]["x"][:], rows["x"])


def test_pending_samples_are_updated(folder, thousand):
    with Dataset.create(folder, durable=True) as dataset:
        for row in range(10):
            dataset.append_sample(
                "training", {name: values[row] for name, values in thousand.rows.items()}
            )
        dataset.update("training", 9, {"x": np.ones(5)})
        assert_array_equal(dataset["training"]["x"][9], np.ones(5))
        assert_array_equal(dataset["training"]["x"][8], thousand.rows["x"][8])


def test_an_invalid_update_changes_nothing(folder, thousand):
    thousand.write(folder)
    with Dataset.open(folder, writable=True) as dataset:
        for index, rows in [
            (0, {"x": np.full(5, np.nan)}), (0, {"x": np.ones(4)}), (0, {"y": np.ones(5)}),
            (slice(0, 2), {"x": np.ones((3, 5))}), (0, {}), (0, {"n": 2.5}),
            ([0, 1], {"x": np.ones((2, 5)), "n": [1]}),
        ]:  # fmt: skip
            with pytest.raises(SampleError):
                dataset.update("training", index, rows)
        for index in (N, -N - 1, [0.5], "x", [[1]]):
            with pytest.raises(IndexError):
                dataset.update("training", index, {"x": np.ones((1, 5))})
        with pytest.raises(DatasetError, match="no mode"):
            dataset.update("other", 0, {"x": np.ones(5)})
    thousand.check(folder, thousand.rows)
    with Dataset.open(folder) as dataset, pytest.raises(UsageError, match="writable=True"):
        dataset.update("training", 0, {"x": np.ones(5)})
    with pytest.raises(NotFiniteError), Dataset.open(folder, writable=True) as dataset:
        dataset.update("training", 0, {"x": np.full(5, np.inf)})


def test_interrupted_update_is_completed_on_open(folder, tmp_path, thousand):
    thousand.write(folder)
    rows = thousand.stacked(thousand.rows)
    rows["x"][:400] = 1
    with Dataset.open(folder, writable=True) as dataset:
        dataset.update("training", slice(0, 400), {"x": rows["x"][:400]})
        shutil.copytree(folder, tmp_path / "killed")
    thousand.check(tmp_path / "killed", rows, counted=False)
    assert "checksums" in "".join(Dataset.repair(tmp_path / "killed"))
    thousand.check(tmp_path / "killed", rows)


def test_statistics_do_not_tell_of_updates_that_the_disk_does_not_have(folder, tmp_path):
    dataset = Dataset.create(folder, max_file_size=1.7e-5)
    dataset.append("training", {"x": np.arange(100.0)})  # 77 of them are sealed
    dataset.recompute_normalization()
    path = folder / "run_training_x_0.h5"
    before = path.read_bytes()
    dataset.update("training", slice(0, 10), {"x": np.full(10, -1e6)})
    assert dataset.recompute_normalization()["x"].mean < -1e3
    shutil.copytree(folder, tmp_path / "cut")
    dataset.close()
    (tmp_path / "cut" / path.name).write_bytes(before)
    for writable in (False, True, False):
        with Dataset.open(tmp_path / "cut", writable=writable) as dataset:
            mean = dataset["training"]["x"][:].mean()
            assert dataset.normalization["x"].mean == pytest.approx(mean)


def test_a_reader_sees_updates_when_it_refreshes(folder, thousand):
    thousand.write(folder)
    with Dataset.open(folder) as reader, Dataset.open(folder, writable=True) as dataset:
        next(reader.batches("training", N))
        dataset.update("training", 0, {"n": 5})
        reader.refresh()
        assert next(reader.batches("training", N))["n"][0] == 5


@pytest.mark.parametrize("closed", [False, True])
def test_an_update_is_no_damage_to_a_reader_that_does_not_refresh(folder, thousand, closed):
    thousand.write(folder)
    with Dataset.open(folder) as reader, Dataset.open(folder, writable=True) as dataset:
        dataset.update("training", slice(5, 400), {"n": np.arange(5, 400) + N})
        if closed:
            dataset.close()
        expected = thousand.rows["n"].copy()
        expected[5:400] += N
        assert_array_equal(reader["training"]["n"][:], expected)
        assert_array_equal(next(reader.batches("training", N))["n"], expected)
        assert reader.verify() == []
        path = folder / "run_training_x_2.h5"
        content = bytearray(path.read_bytes())
        content[-9] ^= 1
        path.write_bytes(content)
        assert "run_training_x_2.h5 was changed" in "".join(reader.verify())
        with pytest.raises(DatasetError, match="was changed or is damaged"):
            reader["training"]["x"][:]


def test_a_number_of_a_removed_partition_is_not_used_again(folder, thousand):
    thousand.write(folder)
    with Dataset.open(folder, writable=True, session="b") as dataset:
        dataset.append("training", thousand.part(0, 400))
    with Dataset.open(folder) as reader:
        with Dataset.open(
            folder, writable=True, session="run", max_file_size=thousand.size
        ) as dataset:
            dataset.remove_partition("training", 2, "run")
        with Dataset.open(folder, writable=True, session="run") as dataset:
            dataset.append("training", thousand.part(0, 320))
        for rows in (slice(None), slice(900, 905)):  # never those that were appended last
            with pytest.raises(DatasetError, match="run_training_n_2.h5 is missing"):
                reader["training"]["n"][rows]


# Merging ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shared", [False, True])
def test_a_merged_dataset_holds_the_rows_of_both(folder, tmp_path, shared, thousand):
    thousand.write(folder, thousand.part(0, 400))
    thousand.write(tmp_path / "other", thousand.part(400, 1000), "other")
    with Dataset.open(tmp_path / "other", writable=True) as other:
        other.update_info(seed=7)
    before = {p.name: p.read_bytes() for p in (tmp_path / "other").iterdir()}
    with Dataset.open(folder, writable=True, shared=shared, max_file_size=thousand.size) as dataset:
        dataset.append("training", thousand.part(0, 10))
        dataset.merge(tmp_path / "other")
        assert_array_equal(
            dataset["training"]["n"][:],
            thousand.stacked(thousand.rows, (0, 10))["n"][ORDER],
        )
        dataset.append("training", thousand.part(10, 20))
        assert dataset.info["merged"] == [{"seed": 7}]
    rows = thousand.stacked((0, 400), (0, 10), (400, 1000), (10, 20))
    thousand.check(folder, rows)
    assert {p.name: p.read_bytes() for p in (tmp_path / "other").iterdir()} == before
    (folder / "dataset.json").unlink()
    Dataset.rebuild(folder)
    thousand.check(folder, rows)


ORDER = np.r_[0:400, 1000:1010, 400:1000]


def test_merging_adds_modes_and_what_a_killed_writer_left(folder, tmp_path, thousand):
    live = Dataset.create(tmp_path / "live", max_file_size=thousand.size)
    live.append("training", thousand.rows)
    live.append("validation", {"y": [1.0, 2.0]})
    shutil.copytree(tmp_path / "live", tmp_path / "killed")
    live.close()
    with Dataset.create(folder) as dataset:
        dataset.merge(tmp_path / "killed")
        dataset.merge(tmp_path / "killed")
        assert_array_equal(dataset["validation"]["y"], [1, 2, 1, 2])
    thousand.check(folder, thousand.stacked(thousand.rows, thousand.rows))


def test_statistics_are_merged_and_not_recomputed(folder, tmp_path, thousand):
    thousand.write(folder)
    thousand.write(tmp_path / "other")
    place = tmp_path / "other" / "dataset.json"
    plain = json.loads(place.read_text())
    arrays = load_file(place.parent / plain["statistics"]["file"])
    arrays["training/x/mean"][:] = 4
    content = save(arrays)
    crc32 = f"{zlib.crc32(content):08x}"
    plain["statistics"] = {"file": f"statistics_{crc32}.safetensors", "crc32": crc32}
    (place.parent / plain["statistics"]["file"]).write_bytes(content)
    write_manifest(place, plain)
    with Dataset.open(folder, writable=True) as dataset:
        dataset.merge(tmp_path / "other")
        mean = dataset.normalization["x"].mean
        np.testing.assert_allclose(mean, (thousand.rows["x"].mean(axis=0) + 4) / 2)
        found = dataset.recompute_normalization()["x"].mean
        np.testing.assert_allclose(found, thousand.rows["x"].mean(axis=0), atol=1e-12)
    thousand.check(folder, thousand.stacked(thousand.rows, thousand.rows))


def write_manifest(path, plain):
    """Write a manifest with a valid checksum."""
    plain = {name: value for name, value in plain.items() if name != "crc32"}
    body = json.dumps(plain, indent=1).encode()[:-2]
    path.write_bytes(body + b',\n "crc32": "%08x"\n}' % zlib.crc32(body))


def test_an_invalid_merge_changes_nothing(folder, tmp_path, thousand):
    thousand.write(folder)
    thousand.write(tmp_path / "other")
    with Dataset.create(tmp_path / "fields") as dataset:
        dataset.append("another", {"x": np.ones((2, 4))})
        dataset.append("training", {"x": np.ones((2, 4))})
    path = tmp_path / "other" / "run_training_x_2.h5"
    damaged = bytearray(path.read_bytes())
    damaged[-9] ^= 1
    path.write_bytes(damaged)
    with Dataset.open(folder, writable=True) as dataset:
        with pytest.raises(FieldsMismatchError):
            dataset.merge(tmp_path / "fields")
        assert dataset.modes == ["training"]
        with pytest.raises(DatasetError, match=r"run_training_x_2\.h5 was changed.*Nothing was m"):
            dataset.merge(tmp_path / "other")
        with pytest.raises(DatasetError, match="itself"):
            dataset.merge(folder)
        with pytest.raises(DatasetNotFoundError):
            dataset.merge(tmp_path / "missing")
        path.unlink()
        with pytest.raises(DatasetError, match=r"run_training_x_2\.h5 is missing"):
            dataset.merge(tmp_path / "other")
    thousand.check(folder, thousand.rows)
    assert len(list(folder.glob("run_training_x_*.h5"))) == 3
    with Dataset.open(folder) as dataset, pytest.raises(UsageError):
        dataset.merge(tmp_path / "other")


# Removing ---------------------------------------------------------------------------------------


def test_a_removed_partition_is_gone(folder, thousand):
    thousand.write(folder)
    with Dataset.open(folder, writable=True, session="b", max_file_size=thousand.size) as dataset:
        dataset.append("training", thousand.part(0, 400))
        next(dataset.batches("training", 5))
        assert dataset.remove_partition("training", 1, "run") == 340
        assert_array_equal(dataset["training"]["n"][335:345], [*range(335, 340), *range(680, 685)])
        assert next(dataset.batches("training", 2000))["n"][340] == 680
        assert not list(folder.glob("run_training_*_1.h5"))
        assert dataset.remove_partition("training", 1) == 60  # the open one of session b
        dataset.append("training", thousand.part(500, 510))
    rows = thousand.stacked((0, 340), (680, 1000), (0, 340), (500, 510))
    thousand.check(folder, rows)
    Dataset.rebuild(folder)
    thousand.check(folder, rows)


def test_a_missing_partition_cannot_be_removed(folder, thousand):
    thousand.write(folder)
    with Dataset.open(folder, writable=True, session="b") as dataset:
        dataset.append("training", thousand.part(0, 10))
        for index, session, match in [
            (3, None, "no partition 3"), (0, None, "several partitions 0"), (1, "b", "no part"),
        ]:  # fmt: skip
            with pytest.raises(DatasetError, match=match):
                dataset.remove_partition("training", index, session)
        with pytest.raises(DatasetError, match="no mode"):
            dataset.remove_partition("other", 0)
        dataset.append("training", thousand.part(10, 20))  # to the same partition
        assert dataset.describe()[0]["partitions"] == 4
    thousand.check(folder, thousand.stacked(thousand.rows, (0, 20)))


def test_interrupted_removal_is_completed_on_open(folder, thousand):
    thousand.write(folder)
    plain = json.loads((folder / "dataset.json").read_text())
    mode = plain["modes"]["training"]
    mode["dropped"] = [mode["partitions"].pop(1)]
    for partition in mode["partitions"]:
        partition["counted"] = False
    write_manifest(folder / "dataset.json", plain)
    (folder / "run_training_n_1.h5").unlink()
    rows = thousand.stacked((0, 340), (680, 1000))
    thousand.check(folder, rows, counted=False)
    Dataset.open(folder, writable=True).close()
    thousand.check(folder, rows)
    assert not list(folder.glob("run_training_*_1.h5"))
