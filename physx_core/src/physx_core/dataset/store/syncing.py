"""Syncs written files to disk about once a second, beside the thread that writes them."""

from __future__ import annotations

import contextlib
import threading
from itertools import chain
from pathlib import Path
from typing import Protocol, TypeVar

from physx_core import files
from physx_core.dataset.store.partition.file import PartitionFile, sync_named
from physx_core.processes import Helper

T = TypeVar("T")

PERIOD = 1.0
"""Seconds between two syncs of the same file."""


class Written(Protocol):
    """A partition that is being written."""

    files: dict[str, PartitionFile]


class Syncer:
    """Syncs written files a second after the first of them was noted.

    A power failure loses at most the rows of about the last second, yet the writer never waits for
    the disk.

    Attributes:
        error: The error of the first failed sync, if any.
    """

    def __init__(self, helper: Helper[None]) -> None:
        self._helper = helper
        self._partitions: dict[Written, None] = {}
        self._paths: dict[Path, None] = {}
        self._lock = threading.Lock()
        self.error: OSError | None = None

    def note(self, partition: Written) -> None:
        """Schedule an open partition; its rows are synced and marked."""
        if partition not in self._partitions:
            self._schedule(self._partitions, partition)

    def note_path(self, path: Path) -> None:
        """Schedule a file by its path."""
        if path not in self._paths:
            self._schedule(self._paths, path)

    def check(self) -> None:
        """Raise the error of the first failed sync, if any.

        Once a sync has failed, nothing written before it can be considered stored.
        """
        if self.error is not None:
            raise self.error

    def sync(self) -> None:
        """Sync everything that is scheduled now; a failure is reported by `check`."""
        with self._lock:
            opened, paths = list(self._partitions), list(self._paths)
            self._partitions.clear()
            self._paths.clear()
        try:
            for file in chain.from_iterable(partition.files.values() for partition in opened):
                sync_marked(file)
            for path in paths:
                with contextlib.suppress(FileNotFoundError):  # its partition was removed
                    files.sync_file(path)
            for folder in {path.parent for path in paths}:  # a sealed copy may have its name now
                files.sync_folder(folder)
        except OSError as error:
            self.error = self.error or error

    def close(self) -> None:
        """Sync everything that is left, and close the helper."""
        self._helper.close()
        self.sync()
        self.check()

    def _schedule(self, noted: dict[T, None], one: T) -> None:
        with self._lock:
            is_first = not (self._partitions or self._paths)
            noted[one] = None
        if is_first:
            while self._helper.is_ready:
                self._helper.take()
            self._helper.give(self._sync_later)

    def _sync_later(self) -> None:
        self._helper.pause(PERIOD)
        self.sync()


def sync_marked(file: PartitionFile) -> None:
    """Sync a partition file with a mark of its newest commit."""
    descriptor = file.mark()
    if descriptor < 0:
        return
    try:
        sync_named(descriptor, file.path)
    finally:
        files.close(descriptor)
