"""Keeps the manifest in memory and on the disk, and changes both atomically."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from physx_core import files
from physx_core.dataset.store import locks, manifest_file
from physx_core.dataset.store.manifest import Manifest, Mode


@dataclass
class ManifestStore:
    """The manifest of a dataset that is written by one process or by several.

    If several writers share a dataset, they take turns: each change begins with what the others
    have stored. The partitions that this process writes remain its own throughout.

    Attributes:
        directory: The dataset's folder.
        manifest: What the dataset holds, as far as this process knows.
        shared: Whether other processes write to it too.
        failure: The first sync that failed. Afterwards nothing is changed any more: what was
            written before may be lost, though it can still be read.
    """

    directory: Path
    manifest: Manifest
    shared: bool = False
    failure: files.SyncError | None = None

    @contextlib.contextmanager
    def syncing(self) -> Iterator[None]:
        """Do something only if no sync has failed yet, and note whether one fails now."""
        if self.failure is not None:
            raise self.failure
        try:
            yield
        except files.SyncError as error:
            self.failure = error
            raise

    @contextlib.contextmanager
    def change(self) -> Iterator[Manifest]:
        """Give the manifest to be changed and store it at the end; after an error, restore it."""
        turn = locks.lock_manifest(self.directory) if self.shared else contextlib.nullcontext()
        with self.syncing(), turn:
            if self.shared:
                self.reload(manifest_file.load(self.directory))
            before = self.manifest.copy()
            try:
                yield self.manifest
                manifest_file.save(self.directory, self.manifest)
            except BaseException:
                self.manifest.take(before)
                raise

    def reload(self, now: Manifest) -> None:
        """Take over what other writers have stored."""
        for name, mode in self.manifest.modes.items():
            if name in now.modes:
                _keep_known(now.modes[name], mode)
        self.manifest.take(now)


def _keep_known(mode: Mode, before: Mode) -> None:
    """Keep this process's own partitions, and the rows that others were known to have."""
    known = {partition.key: partition for partition in before.partitions}
    for place, partition in enumerate(mode.partitions):
        earlier = known.get(partition.key)
        if earlier is not None and earlier.writing:
            mode.partitions[place] = earlier
        elif earlier is not None and not partition.sealed:
            partition.rows = max(partition.rows, earlier.rows)
            partition.running = earlier.running
