"""Bugs that a checker of power cuts must find: each is planted in the product for a while."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

from physx_core import files
from physx_core.checkpoint import writing
from physx_core.dataset.repair import recovery
from physx_core.dataset.store import statistics_file, syncing
from physx_core.dataset.store.partition import format as partition_format
from physx_core.dataset.store.partition.commits import Kept
from physx_core.dataset.store.partition.file import PartitionFile
from physx_core.dataset.write import updating
from physx_core.dataset.write.writer import OpenPartition


@dataclass(frozen=True)
class Bug:
    """A bug.

    Attributes:
        what: What is wrong.
        planted: Returns a context in which it is there.
        checkpoints: Whether it is one of checkpoints.
        first: Seed of the first history to look at.
    """

    what: str
    planted: Callable[[], AbstractContextManager[Any]]
    checkpoints: bool = False
    first: int = 0


@contextlib.contextmanager
def _skipped(name: str, caller: str) -> Iterator[None]:
    """Leave out what one function does with `physx_core.files`."""
    do = getattr(files, name)

    def maybe(*given: Any) -> Any:
        return None if sys._getframe(1).f_code.co_name == caller else do(*given)

    with mock.patch.object(files, name, maybe):
        yield


def _skip(name: str, caller: str) -> Callable[[], AbstractContextManager[Any]]:
    return lambda: _skipped(name, caller)


def _instead(owner: Any, name: str, new: Any) -> Callable[[], AbstractContextManager[Any]]:
    return lambda: mock.patch.object(owner, name, new)


def _unsynced(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function during which partition files are not synced."""

    def without(*given: Any) -> Any:
        with mock.patch.object(PartitionFile, "sync", lambda self: None):
            return function(*given)

    return without


def _pieces_of(file: Any, *given: Any, durable: bool) -> list[tuple[bytes, int]]:
    """Return what a file would write, its commit last."""
    found: list[tuple[bytes, int]] = []

    def write(_: int, pieces: Any) -> None:
        found.extend((bytes(content), offset) for content, offset in pieces)

    with mock.patch.object(files, "write_pieces", write):
        file.append(*given, durable=durable)
    return found


def _append_syncing_between(*parts: slice) -> Callable[..., None]:
    """Return an `OpenPartition.append` that writes rows and commit in another order."""

    def append(self: Any, rows: Any, start: int, count: int) -> None:
        first, last = self.partition.rows, self.partition.rows + count
        durable = self._syncer is None
        for name, file in self.files.items():
            if file.room < last:
                file.reserve(last)
            part = rows[name][start : start + count]
            pieces = _pieces_of(file, first, part, last, durable=durable)
            files.write_pieces(file.descriptor, pieces[parts[0]])
            if durable:
                file.sync()
            files.write_pieces(file.descriptor, pieces[parts[1]])
        self.partition.rows = last
        if self._syncer is not None:
            self._syncer.note(self)

    return append


_COMMIT, _REST = slice(-1, None), slice(None, -1)
_append_committing_late = _append_syncing_between(_REST, _COMMIT)
_append_committing_early = _append_syncing_between(_COMMIT, _REST)


def _no_mark(self: Any) -> int:
    return files.duplicate(self.descriptor) if self.descriptor >= 0 else -1


def _mark_one_place(self: Any) -> int:
    self._next_mark = 0
    return int(_mark(self))


def _settle_unsynced(self: Any) -> None:
    with _skipped("sync", "settle"):
        _settle(self)


def _write_unsynced(directory: Path, manifest: Any) -> Any:
    def replace(path: Path, content: bytes) -> None:
        _replace(path, content, wait=False)

    with mock.patch.object(files, "replace", replace):
        return _write_statistics(directory, manifest)


@contextlib.contextmanager
def _merged_unsynced() -> Iterator[None]:
    """Leave out the syncs of the folder before the manifest: new statistics need one, too."""
    unsynced = mock.patch.object(statistics_file, "write", _write_unsynced)
    with _skipped("sync_folder", "add_partitions"), unsynced:
        yield


def _write_clearing_first(directory: Path, manifest: Any) -> Any:
    written = _write_statistics(directory, manifest)
    statistics_file.clear(directory, written)
    return written


_mark, _settle, _replace = PartitionFile.mark, PartitionFile.settle, files.replace
_write_statistics = statistics_file.write


def _newest_record(_: int, rows: Any, commits: Any, *, certain: bool) -> Any:
    return Kept(max(commits), rows)


def _publish_removing_first(partial: Path, path: Path) -> None:
    files.sync_folder(partial)
    if path.is_dir():
        files.remove_folder(path)
    files.rename(partial, path)
    files.sync_folder(path.parent)


def _publish_forgetting_early(partial: Path, path: Path) -> None:
    files.sync_folder(partial)
    former = path.with_name(f".{path.name}.former")
    if path.is_dir():
        files.rename(path, former)
    files.rename(partial, path)
    files.remove_folder(former)
    files.sync_folder(path.parent)


BUGS = (
    Bug(
        "a new file's header is not synced",
        _instead(PartitionFile, "create", _unsynced(PartitionFile.create)),
    ),
    Bug("the manifest is renamed before it is synced", _skip("sync", "replace")),
    Bug("the manifest's new name is not synced", _skip("sync_folder", "replace")),
    Bug(
        "the manifest refers to statistics that are not on the disk",
        _instead(statistics_file, "write", _write_unsynced),
    ),
    Bug(
        "old statistics are removed while the manifest refers to them",
        _instead(statistics_file, "write", _write_clearing_first),
    ),
    Bug("a new partition is not listed on the disk", _skip("sync", "append")),
    Bug(
        "the name of the list of new partitions is not synced",
        _skip("sync_folder", "append"),
        first=38,
    ),
    Bug(
        "a durable append does not sync",
        _instead(OpenPartition, "append", _unsynced(OpenPartition.append)),
    ),
    Bug(
        "a durable append commits after its sync",
        _instead(OpenPartition, "append", _append_committing_late),
        first=6,
    ),
    Bug("rows are committed first", _instead(OpenPartition, "append", _append_committing_early)),
    Bug("digests are not compared", _instead(partition_format, "find_kept", _newest_record)),
    Bug(
        "a power cut is not noticed",
        _instead(partition_format.Inspection, "certain", property(lambda self: True)),
    ),
    Bug("no marks are made", _instead(PartitionFile, "mark", _no_mark), first=17),
    Bug("there is only one mark", _instead(PartitionFile, "mark", _mark_one_place), first=226),
    Bug(
        "rows that follow lost ones are given out",
        _instead(recovery, "_discard_behind_gaps", lambda mode: None),
    ),
    Bug("a sealed copy replaces its original unsynced", _skip("sync", "copy")),
    Bug("a full partition is sealed unsynced", _skip("sync_file", "seal")),
    Bug("the names of sealed copies are not synced", _skip("sync_folder", "seal")),
    Bug(
        "an update is not synced",
        _instead(syncing.Syncer, "note_path", lambda self, path: None),
    ),
    Bug("a durable update does not sync", _skip("sync_file", "note_path")),
    Bug(
        "rows with a digest are updated",
        _instead(OpenPartition, "settle", lambda self, names, last: None),
    ),
    Bug(
        "rows that are not on the disk lose their digest",
        _instead(PartitionFile, "settle", _settle_unsynced),
    ),
    Bug(
        "updated rows of full partitions keep their digest",
        _instead(
            updating, "unseal", lambda _, __, part: replace(part, checksums={}, counted=False)
        ),
        first=62,
    ),
    Bug("merged files are listed before their names are synced", _merged_unsynced),
    Bug("a checkpoint's files are not synced", _skip("sync_file", "_write"), checkpoints=True),
    Bug("a checkpoint's name is not synced", _skip("sync_folder", "_publish"), checkpoints=True),
    Bug(
        "the former best checkpoint is removed first",
        _instead(writing, "_publish", _publish_removing_first),
        checkpoints=True,
    ),
    Bug(
        "the former best checkpoint is removed before the new one is on the disk",
        _instead(writing, "_publish", _publish_forgetting_early),
        checkpoints=True,
    ),
)
"""Bugs, each in one place."""
