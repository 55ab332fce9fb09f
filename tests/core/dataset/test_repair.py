"""Repairing and rebuilding datasets, and reading older versions."""

import json
import os
import shutil
import zlib

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from physx_core import Dataset, files
from physx_core.dataset.store.partition.commits import Commit
from physx_core.errors import (
    DatasetError,
    DatasetLockedError,
    DatasetNotFoundError,
)

# Repairing --------------------------------------------------------------------------------------


def test_a_sound_dataset_needs_no_repair(folder, thousand):
    thousand.write(folder)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert Dataset.repair(folder) == []
    now = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert {**now, "dataset.lock": b""} == {**before, "dataset.lock": b""}
    with pytest.raises(DatasetNotFoundError):
        Dataset.repair(folder / "nowhere")
    with Dataset.open(folder, writable=True), pytest.raises(DatasetLockedError):
        Dataset.repair(folder)


def test_a_manifest_edited_by_hand_is_rejected_and_then_checked(folder, thousand):
    thousand.write(folder, info={"note": "first"})
    path = folder / "dataset.json"
    text = path.read_text()
    path.write_text(text.replace('"first"', '"second"'))
    with pytest.raises(DatasetError, match=r"dataset\.json.*edited by hand.*repair"):
        Dataset.open(folder)
    assert "it matches the files and is kept" in Dataset.repair(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.info == {"note": "second"}
    thousand.check(folder, thousand.rows)


@pytest.mark.parametrize(
    ("old", "new"),
    [('"<f8"', '"<f4"'), ("12288", "12296"), ('"rows": 340', '"rows": 330'), ('"x"', '"z"'),
     ('"index": 1', '"index": 0')],
)  # fmt: skip
def test_a_wrong_edit_is_undone(folder, old, new, thousand):
    thousand.write(folder)
    path = folder / "dataset.json"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    done = Dataset.repair(folder)
    assert any("dataset.json.1" in each for each in done)
    thousand.check(folder, thousand.rows)
    assert new in (folder / "dataset.json.1").read_text()


@pytest.mark.parametrize("text", [None, b"", b"{", b"[]", b"\xff", b"null", b"[" * 100_000])
def test_repair_rebuilds_lost_or_corrupt_manifest(folder, text, thousand):
    thousand.write(folder)
    (folder / "dataset.json").unlink()
    if text is not None:
        (folder / "dataset.json").write_bytes(text)
        with pytest.raises(DatasetError, match=r"dataset\.json.*repair"):
            Dataset.open(folder)
    assert Dataset.repair(folder)
    thousand.check(folder, thousand.rows)
    assert Dataset.repair(folder) == []


@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("damage", ["missing", "cut", "garbage", "flipped", "link"])
def test_a_partition_that_cannot_be_used_is_set_aside(folder, tmp_path, damage, lost, thousand):
    thousand.write(folder)
    path = folder / "run_training_x_1.h5"
    content = path.read_bytes()
    if damage == "cut":
        path.write_bytes(content[:9000])
    elif damage == "garbage":
        path.write_bytes(bytes(len(content)))
    elif damage == "flipped":
        path.write_bytes(content[:-100] + bytes([content[-100] ^ 4]) + content[-99:])
    elif damage == "link":
        path.rename(tmp_path / path.name)
        path.symlink_to(tmp_path / path.name)
    else:
        path.unlink()
    if lost:
        (folder / "dataset.json").unlink()
        if damage in ("flipped", "missing"):
            return  # nothing tells that anything is wrong, or the whole partition has to go
    done = "".join(Dataset.repair(folder))
    assert "run_training_x_1.h5" in done and "damaged" in done
    if not lost:
        assert "340 rows" in done
        thousand.check(folder, thousand.stacked((0, 340), (680, 1000)))
        assert (folder / "damaged" / "run_training_n_1.h5").exists()
        assert Dataset.repair(folder) == []
        assert damage == "missing" or os.path.lexists(folder / "damaged" / path.name)


def test_sound_rows_get_a_new_header(folder, thousand):
    thousand.write(folder)
    path = folder / "run_training_x_1.h5"
    content = bytearray(path.read_bytes())
    content[100:600] = bytes(500)
    path.write_bytes(content)
    with Dataset.open(folder) as dataset:
        assert len(dataset.verify()) == 1
    assert "header has been rewritten" in Dataset.repair(folder)[0]
    thousand.check(folder, thousand.rows)
    with h5py.File(path) as file:
        assert_array_equal(file["data"][:], thousand.rows["x"][340:680])


def test_a_rebuilt_manifest_keeps_the_old_one(folder, thousand):
    thousand.write(folder, info={"a": 1})
    before = (folder / "dataset.json").read_bytes()
    Dataset.rebuild(folder)
    thousand.check(folder, thousand.rows)
    assert (folder / "dataset.json.1").read_bytes() == before
    with Dataset.open(folder) as dataset:
        assert dataset.info == {}
        assert dataset.fields("training") == {field.name: field for field in thousand.fields}


def torn(content, how):
    """Content of a file of which only some sectors reached the disk."""
    if how == "nothing":
        return bytes(len(content))
    if how == "no sector":
        return b""
    if how == "first sector":
        return content[:512] + bytes(len(content) - 512)
    return bytes(512) + content[512:]


@pytest.mark.parametrize("how", ["nothing", "no sector", "first sector", "all but the first"])
@pytest.mark.parametrize("call", ["open", "repair", "rebuild"])
def test_a_torn_file_that_nobody_lists_is_set_aside(folder, call, how, thousand):
    thousand.write(folder)
    content = torn((folder / "run_training_x_0.h5").read_bytes(), how)
    (folder / "run_training_x_9.h5").write_bytes(content)
    if call == "open":
        Dataset.open(folder, writable=True).close()
    elif call == "repair":
        assert "run_training_x_9.h5" in "".join(Dataset.repair(folder))
    else:
        Dataset.rebuild(folder)
    assert (folder / "damaged" / "run_training_x_9.h5").read_bytes() == content
    assert not (folder / "run_training_x_9.h5").exists()
    thousand.check(folder, thousand.rows)
    assert Dataset.repair(folder) == []


def test_files_that_are_nobodys_stay_where_they_are(folder, tmp_path, thousand):
    thousand.write(folder)
    (tmp_path / "elsewhere").write_bytes(b"")
    (folder / "run_training_x_8.h5").symlink_to(tmp_path / "elsewhere")
    (folder / "notes.h5").write_bytes(b"")
    with h5py.File(folder / "run_training_x_9.h5", "w") as file:
        file["mine"] = 1
    Dataset.open(folder, writable=True).close()
    assert Dataset.repair(folder) == []
    for name in ("run_training_x_8.h5", "notes.h5", "run_training_x_9.h5"):
        assert (folder / name).exists()
    thousand.check(folder, thousand.rows)


@pytest.mark.parametrize("listed", [True, False])
def test_rebuilding_leaves_a_damaged_partition_to_repair(folder, listed, thousand):
    thousand.write(folder)
    (folder / "run_training_x_1.h5").write_bytes(b"")
    if not listed:
        (folder / "dataset.json").unlink()
    with pytest.raises(DatasetError, match=r"run_training_x_1\.h5.*Nothing was rebuilt.*repair"):
        Dataset.rebuild(folder)
    assert not (folder / "damaged").exists()
    Dataset.repair(folder)
    assert (folder / "damaged" / "run_training_x_1.h5").exists()
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []


class Killed(BaseException):
    """What ends a process at an operation, in place of a signal."""


class Mortal:
    """Stands in for `os`; after some changes of the disk, nothing is done any more."""

    CHANGES = ("pwrite", "ftruncate", "copy_file_range", "replace", "unlink", "mkdir")

    def __init__(self, changes):
        self.left = changes

    def __getattr__(self, name):
        found = getattr(os, name)
        if not callable(found) or name == "close":  # which the end of a process does, too
            return found

        def call(*arguments, **options):
            self.left -= name in self.CHANGES
            if self.left < 0:
                raise Killed
            return found(*arguments, **options)

        return call


def killed_at(monkeypatch, changes, call):
    """Let a call make so many changes, and then no more; return whether it was cut off."""
    with monkeypatch.context() as patched:
        patched.setattr(files, "os", Mortal(changes))
        try:
            call()
        except Killed:
            return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("call", ["rebuild", "repair"])
def test_killed_rebuild_always_leaves_a_manifest(folder, call, thousand, monkeypatch):
    left = folder.with_name("left")
    thousand.write(left, thousand.part(0, 340), info={"a": 1})
    with Dataset.open(left, writable=True, max_file_size=thousand.size) as dataset:
        dataset.append("training", thousand.part(340, 500))
        shutil.copytree(left, folder)  # with a partition that is open
    if call == "repair":
        text = (folder / "dataset.json").read_text()
        (folder / "dataset.json").write_text(text.replace('"<f8"', '"<f4"'))
    before = (folder / "dataset.json").read_bytes()
    count, cut = 0, True
    while cut:
        copy = shutil.copytree(folder, folder.with_name("copy"))
        cut = killed_at(monkeypatch, count, lambda copy=copy: getattr(Dataset, call)(copy))
        assert (copy / "dataset.json").exists(), count
        now = (copy / "dataset.json").read_bytes()
        kept = [now, *(path.read_bytes() for path in copy.glob("dataset.json.?"))]
        assert any(json.loads(manifest)["info"] == {"a": 1} for manifest in kept)
        if now == before and call == "repair":
            Dataset.repair(copy)
        thousand.check(copy, thousand.part(0, 500), counted=False)
        shutil.rmtree(copy)
        count += 1 if call == "rebuild" else 4
    assert count > 20


# Versions ---------------------------------------------------------------------------------------


def test_a_newer_version_is_rejected(folder, thousand):
    thousand.write(folder)
    path = folder / "dataset.json"
    plain = json.loads(path.read_text()) | {"format_version": 3}
    path.write_text(json.dumps(plain))
    with pytest.raises(
        DatasetError,
        match=r"version 3 of the dataset's format, but this physx reads version 1",
    ):
        Dataset.open(folder)


# Losing no sound row ---------------------------------------------------------------------------


def make(folder):
    with Dataset.create(folder, max_file_size=2.4e-5) as dataset:  # a few hundred rows a file
        for start in range(0, 2000, 100):
            x = np.arange(start, start + 100.0)
            dataset.append("training", {"x": x[:, None].repeat(3, 1), "y": x})
        return len(list(folder.glob("*_x_*.h5")))


def test_a_missing_file_costs_its_own_partition_only(tmp_path):
    folder = tmp_path / "data"
    assert make(folder) > 3
    rows = 2000
    lost = folder / "run_training_x_1.h5"
    (folder / "dataset.json").unlink()
    lost.unlink()
    Dataset.repair(folder)
    with Dataset.open(folder) as dataset:
        y = dataset["training"]["y"][:]
        assert dataset.verify() == []
        assert np.array_equal(dataset["training"]["x"][:][:, 2], y)
    missing = np.setdiff1d(np.arange(rows), y)
    assert 0 < len(missing) < rows / 3
    assert np.array_equal(missing, np.arange(missing[0], missing[-1] + 1))


def test_numbers_are_on_one_line_of_the_manifest(tmp_path):
    make(tmp_path / "data")
    text = (tmp_path / "data/dataset.json").read_text()
    assert '"shape": [3]' in text


def test_repairing_keeps_the_rows_before_those_that_did_not_reach_the_disk(tmp_path):
    writer = Dataset.create(tmp_path / "data", durable=True, max_file_size=1e-3)
    for rows in (4, 3):
        writer.append("training", {"x": np.arange(1.0, rows + 1)})
    shutil.copytree(tmp_path / "data", tmp_path / "cut")
    writer.close()
    path = tmp_path / "cut" / "run_training_x_0.h5"
    content = path.read_bytes()
    lost = content.rfind(np.arange(1.0, 4).tobytes())
    path.write_bytes(content[:lost] + bytes(24) + content[lost + 24 :])
    Dataset.repair(tmp_path / "cut")
    with Dataset.open(tmp_path / "cut") as dataset:
        assert_array_equal(dataset["training"]["x"][:], [1, 2, 3, 4])
        assert dataset.verify() == []


def test_rebuilding_keeps_updated_rows_of_full_partitions(tmp_path):
    folder = tmp_path / "data"
    with Dataset.create(folder, max_file_size=1.7e-5) as dataset:
        dataset.append("training", {"x": np.arange(1000.0)})
        dataset.update("training", 3, {"x": -1.0})
    Dataset.rebuild(folder)
    wanted = np.arange(1000.0)
    wanted[3] = -1
    with Dataset.open(folder) as dataset:
        assert_array_equal(dataset["training"]["x"][:], wanted)
        assert dataset.verify() == []


def test_rebuilding_forgets_what_was_being_removed_and_what_was_never_committed(tmp_path):
    folder = tmp_path / "data"
    writer = Dataset.create(folder, max_file_size=1.7e-5)
    writer.append("training", {"x": np.arange(200.0), "y": np.arange(200.0)})
    writer.append("test", {"x": np.arange(2.0), "y": np.arange(2.0)})
    shutil.copytree(folder, tmp_path / "before")
    writer.remove_partition("training", 1)
    writer.close()
    folder = tmp_path / "before"  # the writer was killed while it removed the partition
    plain = json.loads((folder / "dataset.json").read_text())
    plain["modes"]["training"]["dropped"] = [plain["modes"]["training"]["partitions"].pop(1)]
    del plain["crc32"]
    body = json.dumps(plain, indent=1).encode()[:-2]
    end = f',\n "crc32": "{zlib.crc32(body):08x}"\n}}'
    (folder / "dataset.json").write_bytes(body + end.encode())
    (folder / "run_training_y_1.h5").unlink()
    with h5py.File(folder / "run_test_y_0.h5", "r+") as file:  # ... or before its second field
        file["rows"][()] = 0
        file["commits"][...] = np.array([Commit.unchecked(0)] * 3, "u8")
    Dataset.rebuild(folder)
    with Dataset.open(folder) as dataset:
        assert dataset.modes == ["training"]
        expected = [*range(77), *range(154, 200)]
        assert_array_equal(dataset["training"]["x"][:], expected)
        assert_array_equal(dataset["training"]["y"][:], expected)
        assert dataset.verify() == []
    assert not list(folder.glob("*_test_*"))
