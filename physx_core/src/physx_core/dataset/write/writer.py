"""Writes rows to partitions, which begin and end at the same row in all fields of a mode."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from physx_core import files
from physx_core.dataset.read.mode_statistics import compute_statistics, count_sealed
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.repair import recovery
from physx_core.dataset.store import locks, manifest_file
from physx_core.dataset.store.manifest import Mode, Partition
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.partition_file import PartitionFile
from physx_core.dataset.store.sealing import remove_files, seal
from physx_core.dataset.store.syncing import Syncer
from physx_core.dataset.store.virtual_index import write_index
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.typing import Batch

_HEADER = 2**14


class OpenPartition:
    """The files of the partition of one mode that is being written.

    Attributes:
        partition: Its entry in the manifest.
        capacity: How many rows fit in.
    """

    def __init__(
        self,
        partition: Partition,
        capacity: int,
        parts: dict[str, PartitionFile],
        syncer: Syncer | None,
    ) -> None:
        self.partition = partition
        self.capacity = capacity
        self._files = parts
        self._syncer = syncer

    @property
    def free(self) -> int:
        """How many rows still fit in."""
        return self.capacity - self.partition.rows

    def append(self, rows: Batch, start: int, count: int) -> None:
        """Write and commit rows `start` to `start + count` of a block; all of them, or none."""
        if self._syncer is not None:
            self._syncer.check()
        first = self.partition.rows
        last = first + count
        for file in self._files.values():
            file.reserve(last)
        for name, file in self._files.items():
            file.write(first, rows[name][start : start + count])
        self._wait()
        try:
            for file in self._files.values():
                file.commit(last)
            self._wait()
        except BaseException:  # an interrupt, too: the next rows go to the same offsets
            for file in self._files.values():
                file.commit(first)
            raise
        self.partition.rows = last
        if self._syncer is not None:
            for file in self._files.values():
                self._syncer.note(file.descriptor)

    def close(self) -> None:
        """Close the files, immediately or after their last sync."""
        for file in self._files.values():
            if self._syncer is not None:
                self._syncer.retire(file.hand_over())
            else:
                file.close()

    def _wait(self) -> None:
        """Wait for the disk, unless a syncer does."""
        if self._syncer is None:
            for file in self._files.values():
                file.sync()


class Writer:
    """Appends checked rows to the modes of a dataset.

    Attributes:
        store: The manifest, kept up to date in memory and on the disk.
        session: Name of the session that writes.
        durable: Whether a commit waits for the disk.
    """

    def __init__(
        self, store: ManifestStore, session: str, max_file_size: float, durable: bool, lock: int
    ) -> None:
        """Start without an open partition.

        Args:
            store: The manifest.
            session: Name of the session that writes.
            max_file_size: Size in GB at which a partition is full.
            durable: Whether a commit waits for the disk; otherwise files are synced about once a
                second.
            lock: Descriptor of the dataset's lock, which `close` releases.
        """
        self.store = store
        self.session = session
        self.durable = durable
        self._lock = lock
        self._directory = store.directory
        self._max_nbytes = int(max_file_size * 1e9) - _HEADER
        self._syncer = None if durable else Syncer()
        self._reader = Reader(store.directory, store.manifest)
        self._open: dict[str, OpenPartition] = {}
        self._sealing: deque[Future[Partition]] = deque()
        self._sealed: list[Partition] = []
        self._sealer = ThreadPoolExecutor(1, "physx-seal")

    def append(self, mode_name: str, rows: Batch, count: int) -> None:
        """Store and commit rows.

        Args:
            mode_name: Name of a mode whose fields all have shapes.
            rows: Field name to checked rows.
            count: How many rows there are.
        """
        if self._sealing:
            with contextlib.suppress(OSError):  # noted later; storing the rows fails, too
                self._collect(wait=False)
        done = 0
        while done < count:
            try:
                partition = self._open.get(mode_name)
                if partition is None or not partition.free:
                    if partition is not None:
                        self._retire(mode_name)
                    partition = self._open[mode_name] = self._begin(mode_name)
                part = min(partition.free, count - done)
                partition.append(rows, done, part)
                done += part
            except OSError as error:
                what = f"{count - done} of {count} rows of mode {mode_name!r}"
                safe = f"The {self.store.manifest.modes[mode_name].rows} samples before them"
                raise files.storage_error(what, error, safe) from error

    def refresh(self) -> None:
        """Learn what other writers have committed."""
        if self.store.shared:
            with files.storing("What other writers did"), locks.lock_manifest(self._directory):
                self.store.reload(recovery.load(self._directory))

    def finish(self, mode_name: str) -> None:
        """Seal the open partition of a mode, if there is one, and wait until all are sealed."""
        if mode_name in self._open:
            self._retire(mode_name)
        self.wait()

    def wait(self) -> None:
        """Wait until all full partitions are sealed."""
        self._collect(wait=True)

    def close(self) -> None:
        """Seal what is open, write manifest and index, and release the lock.

        On a full disk the last partitions remain unsealed: all their rows can be read, and the
        next writer seals them.
        """
        try:
            with files.storing("The dataset's last partition"):
                for mode_name in list(self._open):
                    self._retire(mode_name)
                self._collect(wait=True)
                self._complete()
        except DatasetError as error:
            cause = error.__cause__
            if not (isinstance(cause, OSError) and cause.errno in files.FULL):
                raise
        finally:
            self._sealer.shutdown()
            for opened in self._open.values():
                opened.close()
            self._open.clear()
            try:
                if self._syncer is not None:
                    with files.storing("The last rows"):
                        self._syncer.close()
            finally:
                files.close(self._lock)

    def _retire(self, mode_name: str) -> None:
        """Close the open partition of a mode and have it sealed in the background."""
        opened = self._open.pop(mode_name)
        entry = opened.partition
        entry.writing = not opened.free  # one that is full keeps its files as they are
        opened.close()
        fields = self.store.manifest.modes[mode_name].fields
        work = self._sealer.submit(_seal, self._directory, fields, replace(entry))
        self._sealing.append(work)

    def _collect(self, *, wait: bool) -> None:
        """Note in the manifest which partitions have been sealed."""
        while self._sealing and (wait or self._sealing[0].done()):
            self._sealed.append(self._sealing.popleft().result())
        if not self._sealed:
            return
        with self.store.change() as manifest:
            for entry in self._sealed:
                mode = manifest.modes[entry.mode]
                if entry.rows:
                    mode.swap(entry)
                    count_sealed(mode)
                else:
                    del mode.partitions[mode.place(entry)]
            write_index(self._directory, self.session, manifest)
        empty = [entry for entry in self._sealed if not entry.rows]
        self._sealed.clear()
        for entry in empty:
            remove_files(self._directory, self.store.manifest.modes[entry.mode].fields, entry)

    def _begin(self, mode_name: str) -> OpenPartition:
        """Create the files of a partition, then list it; only then may rows be committed."""
        parts: dict[str, PartitionFile] = {}
        try:
            with self.store.change() as manifest:
                mode = manifest.modes[mode_name]
                row_nbytes = max(1, *(field.nbytes for field in mode.fields.values()))
                capacity = max(1, self._max_nbytes // row_nbytes)
                entry = self.new_partition(mode_name, mode)
                entry.writing = True
                for name, field in mode.fields.items():
                    identity = entry.identity(field)
                    parts[name] = PartitionFile.create(self._directory, identity, capacity)
                    entry.offsets[name] = parts[name].data_offset
                for part in parts.values():
                    part.publish()
                mode.partitions.append(entry)
        except BaseException:
            for part in parts.values():
                part.discard()
            raise
        return OpenPartition(entry, capacity, parts, self._syncer)

    def new_partition(self, mode_name: str, mode: Mode) -> Partition:
        """Return a partition with the first number whose files do not exist yet."""
        listed = (*mode.partitions, *mode.dropped)
        used = [partition.index for partition in listed if partition.session == self.session]
        entry = Partition(mode_name, self.session, max(used, default=-1) + 1, mode.next_row)
        while any(entry.path(self._directory, name).exists() for name in mode.fields):
            entry = replace(entry, index=entry.index + 1)
        return entry

    def _complete(self) -> None:
        """Compute what is missing: checksums of updated partitions, statistics, the index."""
        if self.store.shared:
            return
        manifest = self.store.manifest
        changed = recovery.complete_checksums(self._directory, manifest)
        for name, mode in manifest.modes.items():
            if any(partition.sealed and not partition.counted for partition in mode.partitions):
                changed = True
                with contextlib.suppress(DatasetError):  # a partition is damaged: not now
                    compute_statistics(self._reader, name)
        if changed:
            manifest_file.save(self._directory, manifest)
        write_index(self._directory, self.session, manifest)


def _seal(directory: Path, fields: Mapping[str, Field], partition: Partition) -> Partition:
    return seal(directory, fields, partition) if partition.rows else partition
