"""Syncs written files to disk about once a second, in a background thread."""

from __future__ import annotations

import contextlib
import threading
from itertools import chain
from pathlib import Path
from typing import Protocol

from physx_core import files
from physx_core.dataset.store.partition.file import PartitionFile, sync_named
from physx_core.processes import BackgroundThread

PERIOD = 1.0
"""Seconds between two syncs of the same file."""


class Written(Protocol):
    """A partition that is being written."""

    files: dict[str, PartitionFile]


class Syncer:
    """Syncs written files in a thread that starts with the first of them.

    A power failure loses at most the rows of about the last second, yet the writer never waits for
    the disk.

    Attributes:
        error: The error of the first failed sync, if any.
    """

    def __init__(self, period: float = PERIOD) -> None:
        self._period = period
        self._partitions: dict[Written, None] = {}
        self._paths: dict[Path, None] = {}
        self._lock = threading.Lock()
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread: BackgroundThread | None = None
        self.error: OSError | None = None

    def note(self, partition: Written) -> None:
        """Schedule an open partition; its rows are synced and marked."""
        if partition not in self._partitions:
            with self._lock:
                self._partitions[partition] = None
            self._start()

    def note_path(self, path: Path) -> None:
        """Schedule a file by its path."""
        if path not in self._paths:
            with self._lock:
                self._paths[path] = None
            self._start()

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
                _sync_marked(file)
            for path in paths:
                with contextlib.suppress(FileNotFoundError):  # its partition was removed
                    files.sync_file(path)
            for folder in {path.parent for path in paths}:  # a sealed copy may have its name now
                files.sync_folder(folder)
        except OSError as error:
            self.error = self.error or error

    def close(self) -> None:
        """Sync everything that is left and stop the thread."""
        self._end.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.sync()
        self.check()

    def _start(self) -> None:
        self._wake.set()
        if self._thread is None:
            self._thread = BackgroundThread(self._run, "physx-sync")
            self._thread.start()

    def _run(self) -> None:
        while not self._end.is_set():
            self._wake.wait()
            self._wake.clear()
            if not self._end.wait(self._period):
                self.sync()


def _sync_marked(file: PartitionFile) -> None:
    """Sync a partition file with a mark of its newest commit."""
    descriptor = file.mark()
    if descriptor < 0:
        return
    try:
        sync_named(descriptor, file.path)
    finally:
        files.close(descriptor)
