"""Keeps the manifest in memory and on disk, and changes both atomically."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from physx_core import files
from physx_core.dataset.store import locks, manifest_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition


@dataclass
class ManifestStore:
    """The manifest of a dataset that is written by one or more processes.

    Writers that share a dataset take turns: each change starts from what the others have stored.
    Partitions that this process writes are never changed by others.

    Attributes:
        directory: The dataset's folder.
        manifest: The dataset's contents as known to this process.
        shared: Whether other processes write to it too.
        failure: Error of the first failed sync. After it, nothing is changed any more: rows
            written before may be lost even if they can still be read.
    """

    directory: Path
    manifest: Manifest
    shared: bool = False
    failure: files.SyncError | None = None

    @contextlib.contextmanager
    def syncing(self) -> Iterator[None]:
        """Raise the error of an earlier failed sync, if any, and record a new one."""
        if self.failure is not None:
            raise self.failure
        try:
            yield
        except files.SyncError as error:
            self.failure = error
            raise

    @contextlib.contextmanager
    def turn(self) -> Iterator[Manifest]:
        """Yield the manifest, with what other writers have stored; they change nothing meanwhile.

        After an error, the statistics are as before.
        """
        turn = locks.lock_manifest(self.directory) if self.shared else contextlib.nullcontext()
        with self.syncing(), turn:
            if self.shared:
                self._catch_up()
            manifest = self.manifest
            checksum = manifest.statistics_checksum
            statistics = {name: mode.statistics for name, mode in manifest.modes.items()}
            try:
                yield manifest
            except BaseException:
                manifest.statistics_checksum = checksum
                for name, before in statistics.items():
                    manifest.modes[name].statistics = before
                raise

    def put(self, partitions: list[Partition]) -> None:
        """List partitions that were begun or sealed, in a turn; the others cost nothing.

        The statistics are stored with them.
        """
        if self.manifest.end is not None:
            if partitions:
                manifest_file.append(self.directory, self.manifest, self.manifest.end, partitions)
            return
        for each in partitions:
            self.manifest.modes[each.mode].put(each)
        manifest_file.save(self.directory, self.manifest)

    @property
    def has_grown(self) -> bool:
        """Whether so many partitions were listed that it is time for a `change`."""
        return self.manifest.end is not None and self.manifest.end.is_far

    @contextlib.contextmanager
    def change(self) -> Iterator[Manifest]:
        """Yield the manifest to be changed and store it at the end; after an error, restore it.

        This takes time in proportion to the number of partitions.
        """
        with self.turn() as manifest:
            before = manifest.copy()
            try:
                yield manifest
                manifest_file.save(self.directory, manifest)
            except BaseException:
                manifest.take(before)
                raise

    def _catch_up(self) -> None:
        """Take over what other writers have stored since the last turn."""
        if manifest_file.is_continued(self.directory, self.manifest):
            now = self.manifest.copy()
            manifest_file.load_changes(self.directory, now)
            if now.end == self.manifest.end:
                return
        else:
            now = manifest_file.load(self.directory)
        self.reload(now)

    def reload(self, now: Manifest) -> None:
        """Take over what other writers have stored."""
        for name, mode in self.manifest.modes.items():
            if name in now.modes:
                _keep_known(now.modes[name], mode)
        self.manifest.take(now)


def _keep_known(mode: Mode, before: Mode) -> None:
    """Keep this process's own partitions and the known rows of the others."""
    known = {partition.key: partition for partition in before.partitions}
    for place, partition in enumerate([*mode.partitions]):
        earlier = known.get(partition.key)
        if earlier is not None and earlier.writing:
            mode.partitions.exchange(place, 1, [earlier])
        elif earlier is not None and not partition.sealed:
            partition.rows = max(partition.rows, earlier.rows)
            partition.running = earlier.running
