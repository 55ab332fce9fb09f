"""The model of the disk: what a power cut may leave of tiny programs."""

import errno
import itertools
import os
import random

import pytest
from powercut.disk import SECTOR, Disk, Folder, Killed, Recorder


@pytest.fixture
def recorder(tmp_path):
    (tmp_path / "old").write_bytes(b"o" * 2 * SECTOR)
    return Recorder(tmp_path)


def states(recorder, moment=None, count=400):
    """Return the different trees that a cut may leave: each path to its content."""
    disk = Disk(recorder.top, recorder.journal)
    disk.advance(len(recorder.journal) if moment is None else moment)
    choices = disk.choices(lambda number: random.Random(number))
    return {tuple(sorted(disk.build(c).items())) for c in itertools.islice(choices, count)}


def contents(recorder, name, **options):
    return {dict(tree).get(name, "gone") for tree in states(recorder, **options)}


def write(recorder, path, content, *, sync=False, offset=0, new=True):
    descriptor = recorder.open(path, os.O_RDWR | (os.O_CREAT if new else 0), 0o666)
    recorder.pwrite(descriptor, content, offset)
    if sync:
        recorder.fsync(descriptor)
    recorder.close(descriptor)


def sync_folder(recorder, path):
    descriptor = recorder.open(path, os.O_RDONLY)
    recorder.fsync(descriptor)
    recorder.close(descriptor)


def test_what_was_never_synced_may_be_lost_empty_or_full_of_zeros(recorder, tmp_path):
    write(recorder, tmp_path / "f", b"x" * 10)
    assert contents(recorder, "f") == {"gone", b"", bytes(10), b"x" * 10}


def test_a_synced_file_whose_name_was_not_synced_may_be_gone_but_not_wrong(recorder, tmp_path):
    write(recorder, tmp_path / "f", b"x" * 10, sync=True)
    assert contents(recorder, "f") == {"gone", b"x" * 10}


def test_a_synced_file_in_a_synced_folder_is_there(recorder, tmp_path):
    write(recorder, tmp_path / "f", b"x" * 10, sync=True)
    sync_folder(recorder, tmp_path)
    assert contents(recorder, "f") == {b"x" * 10}
    assert contents(recorder, "old") == {b"o" * 2 * SECTOR}


def test_a_synced_folder_does_not_sync_its_files(recorder, tmp_path):
    write(recorder, tmp_path / "f", b"x" * 10)
    sync_folder(recorder, tmp_path)
    assert contents(recorder, "f") == {b"", bytes(10), b"x" * 10}


def test_writes_are_torn_at_sectors_only(recorder, tmp_path):
    write(recorder, tmp_path / "old", b"n" * 2 * SECTOR, new=False)
    old, new = b"o" * SECTOR, b"n" * SECTOR
    assert contents(recorder, "old") == {old + old, old + new, new + old, new + new}


def test_sectors_keep_any_version_since_the_last_sync(recorder, tmp_path):
    for letter in (b"a", b"b"):
        write(recorder, tmp_path / "old", letter, new=False)
    assert {content[:1] for content in contents(recorder, "old")} == {b"o", b"a", b"b"}
    descriptor = recorder.open(tmp_path / "old", os.O_RDONLY)
    recorder.fdatasync(descriptor)
    assert {content[:1] for content in contents(recorder, "old")} == {b"b"}


def test_later_files_may_be_there_without_earlier_ones(recorder, tmp_path):
    write(recorder, tmp_path / "first", b"1")
    write(recorder, tmp_path / "second", b"2")
    found = {tuple(name for name, _ in tree) for tree in states(recorder)}
    assert ("old", "second") in found


def test_a_rename_happens_as_a_whole_or_not(recorder, tmp_path):
    write(recorder, tmp_path / "draft", b"new", sync=True)
    sync_folder(recorder, tmp_path)
    recorder.replace(tmp_path / "draft", tmp_path / "old")
    before = (("draft", b"new"), ("old", b"o" * 2 * SECTOR))
    assert states(recorder) == {before, (("old", b"new"),)}
    sync_folder(recorder, tmp_path)
    assert states(recorder) == {(("old", b"new"),)}


def test_a_rename_may_be_there_before_the_content(recorder, tmp_path):
    write(recorder, tmp_path / "draft", b"new")
    recorder.replace(tmp_path / "draft", tmp_path / "old")
    sync_folder(recorder, tmp_path)
    assert contents(recorder, "old") == {b"", bytes(3), b"new"}


def test_removals_may_be_undone_until_the_folder_is_synced(recorder, tmp_path):
    recorder.unlink(tmp_path / "old")
    assert "gone" in contents(recorder, "old") and b"o" * 2 * SECTOR in contents(recorder, "old")
    sync_folder(recorder, tmp_path)
    assert contents(recorder, "old") == {"gone"}


def test_what_is_in_a_lost_folder_is_lost(recorder, tmp_path):
    recorder.mkdir(tmp_path / "folder")
    write(recorder, tmp_path / "folder" / "f", b"x", sync=True)
    sync_folder(recorder, tmp_path / "folder")
    assert contents(recorder, "folder/f") == {"gone", b"x"}
    sync_folder(recorder, tmp_path)
    assert contents(recorder, "folder/f") == {b"x"}


def test_a_folder_may_move_before_its_files_are_there(recorder, tmp_path):
    recorder.mkdir(tmp_path / "draft")
    write(recorder, tmp_path / "draft" / "f", b"x")
    recorder.replace(tmp_path / "draft", tmp_path / "final")
    sync_folder(recorder, tmp_path)
    assert contents(recorder, "final/f") == {"gone", b"", b"\0", b"x"}


def test_sizes_may_be_ahead_of_contents_or_behind(recorder, tmp_path):
    descriptor = recorder.open(tmp_path / "old", os.O_RDWR)
    recorder.ftruncate(descriptor, 4 * SECTOR)
    recorder.posix_fallocate(descriptor, 4 * SECTOR, SECTOR)
    recorder.pwrite(descriptor, b"x" * SECTOR, 2 * SECTOR)
    sizes = {len(content) for content in contents(recorder, "old")}
    assert sizes == {2 * SECTOR, 4 * SECTOR, 5 * SECTOR}
    added = {content[2 * SECTOR : 3 * SECTOR] for content in contents(recorder, "old")}
    assert added == {b"", bytes(SECTOR), b"x" * SECTOR}


def test_a_file_that_was_cut_may_have_its_old_content(recorder, tmp_path):
    descriptor = recorder.open(tmp_path / "old", os.O_RDWR | os.O_TRUNC)
    recorder.pwrite(descriptor, b"n", 0)
    found = contents(recorder, "old")
    assert {b"o" * 2 * SECTOR, b"n", b"", b"\0"} <= found
    recorder.fsync(descriptor)
    assert contents(recorder, "old") == {b"n"}


def test_a_later_sync_does_not_bring_back_what_a_failed_one_lost(recorder, tmp_path):
    descriptor = recorder.open(tmp_path / "old", os.O_RDWR)
    recorder.pwrite(descriptor, b"lost" * 128, 0)
    recorder.before = fail_once("fsync")
    with pytest.raises(OSError, match="Input/output"):
        recorder.fdatasync(descriptor)
    recorder.fdatasync(descriptor)
    assert {content[:4] for content in contents(recorder, "old")} == {b"oooo", b"lost"}
    recorder.pwrite(descriptor, b"anew" * 128, 0)
    recorder.fdatasync(descriptor)
    assert {content[:4] for content in contents(recorder, "old")} == {b"anew"}


def fail_once(wanted):
    left = [wanted]

    def before(name):
        if name in left:
            left.remove(name)
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    return before


def test_states_of_each_moment_follow_the_operations(recorder, tmp_path):
    write(recorder, tmp_path / "f", b"x", sync=True)
    sync_folder(recorder, tmp_path)
    assert [contents(recorder, "f", moment=m) for m in range(5)] == [
        {"gone"},
        {"gone", b""},
        {"gone", b"", b"\0", b"x"},
        {"gone", b"x"},
        {b"x"},
    ]


def test_what_a_library_writes_by_itself_is_noticed_at_the_sync(recorder, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "f").write_bytes(b"x" * 600)
    descriptor = recorder.open(tmp_path / "own" / "f", os.O_RDONLY)
    recorder.fsync(descriptor)
    assert contents(recorder, "own/f") == {"gone", b"x" * 600}
    (tmp_path / "own" / "f").write_bytes(b"y" * 600)
    recorder.replace(tmp_path / "own", tmp_path / "other")
    found = contents(recorder, "other/f")
    assert {"gone", b"x" * 600, b"y" * 600, b"y" * SECTOR + b"x" * 88} <= found


def test_copies_by_the_system_are_writes(recorder, tmp_path):
    source = os.open(tmp_path / "old", os.O_RDONLY)
    target = recorder.open(tmp_path / "f", os.O_WRONLY | os.O_CREAT, 0o666)
    recorder.copy_file_range(source, target, SECTOR, 0, 0)
    os.close(source)
    recorder.close(target)
    assert b"o" * SECTOR in contents(recorder, "f")


def test_a_dead_process_changes_nothing_and_holds_nothing(recorder, tmp_path):
    descriptor = recorder.open(tmp_path / "old", os.O_RDWR)
    with pytest.raises(Killed):
        recorder.kill()
    for work in (
        lambda: recorder.pwrite(descriptor, b"n", 0),
        lambda: recorder.unlink(tmp_path / "old"),
        lambda: recorder.close(descriptor),
    ):
        with pytest.raises(Killed):
            work()
    recorder.bury()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(descriptor)
    assert recorder.journal == []


def test_a_folder_takes_one_state_after_another(tmp_path):
    folder = Folder(tmp_path / "state")
    for tree in (
        {"a": b"1", "b": None, "b/c": b"2"},
        {"a": b"1", "b": b"3"},
        {"b": None, "b/d": None, "b/d/e": b"4"},
        {},
    ):
        folder.become(tree)
        found = {
            str(p.relative_to(folder.path)): None if p.is_dir() else p.read_bytes()
            for p in folder.path.rglob("*")
        }
        assert found == tree
