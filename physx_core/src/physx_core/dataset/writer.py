"""Writing rows to partitions, which begin and end at the same row in all fields of a mode."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

from physx_core.dataset import files
from physx_core.dataset.index import write_index
from physx_core.dataset.manifest import Manifest, Mode, Partition
from physx_core.dataset.partition import PartitionFile
from physx_core.dataset.reader import Reader
from physx_core.dataset.sealing import cover, remove_files, seal
from physx_core.errors import DatasetError
from physx_core.fields import Batch

_HEADER = 2**14


class OpenPartition:
    """The partition of one mode that is being written.

    Attributes:
        partition: Its entry in the manifest.
        capacity: How many rows fit in.
    """

    def __init__(
        self, partition: Partition, capacity: int, parts: dict[str, PartitionFile], durable: bool
    ) -> None:
        self.partition = partition
        self.capacity = capacity
        self._files = parts
        self._durable = durable

    @property
    def free(self) -> int:
        """How many rows still fit in."""
        return self.capacity - self.partition.rows

    def append(self, rows: Batch, start: int, count: int) -> None:
        """Write and commit rows `start` to `start + count` of a block; all of them, or none.

        Raises:
            OSError: The disk is full; no row of the block was committed.
        """
        first = self.partition.rows
        last = first + count
        for file in self._files.values():
            file.reserve(last)
        for name, file in self._files.items():
            file.write(first, rows[name][start : start + count])
        self._sync()
        try:
            for file in self._files.values():
                file.commit(last)
            self._sync()
        except BaseException:  # an interrupt, too: the next rows go to the same place
            for file in self._files.values():
                file.commit(first)
            raise
        self.partition.rows = last

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            file.close()

    def _sync(self) -> None:
        if self._durable:
            for file in self._files.values():
                file.sync()


class Writer:
    """Appends checked rows to the modes of a dataset."""

    def __init__(
        self,
        directory: Path,
        manifest: Manifest,
        session: str,
        max_file_size: float,
        durable: bool = False,
    ) -> None:
        """Keep where and how to write.

        Args:
            directory: The dataset's folder.
            manifest: What the dataset holds; kept up to date here and on the disk.
            session: Name of the session that writes.
            max_file_size: Size in GB at which a partition is full.
            durable: Whether a commit waits for the disk, to survive a power cut too.
        """
        self.session = session
        self._directory = directory
        self._manifest = manifest
        self._max_nbytes = int(max_file_size * 1e9) - _HEADER
        self._durable = durable
        self._reader = Reader(directory, manifest)
        self._open: dict[str, OpenPartition] = {}

    def append(self, mode_name: str, rows: Batch, count: int) -> None:
        """Store and commit rows.

        Args:
            mode_name: Name of a mode whose fields all have shapes.
            rows: Field name to checked rows.
            count: How many rows there are.

        Raises:
            DatasetError: The disk is full or fails; says how many of the rows are stored.
        """
        done = 0
        while done < count:
            with files.storing(f"{count - done} of {count} rows of mode {mode_name!r}"):
                partition = self._open.get(mode_name)
                if partition is None or not partition.free:
                    partition = self._next(mode_name)
                part = min(partition.free, count - done)
                partition.append(rows, done, part)
                done += part

    def save(self) -> None:
        """Write the manifest."""
        with files.storing("The dataset's manifest"):
            self._manifest.save(self._directory)

    def close(self) -> None:
        """Seal what is open, and write manifest and index.

        On a full disk the last partitions stay unsealed: all their rows can be read, and the next
        writer seals them.

        Raises:
            DatasetError: A partition is damaged, or the storage fails.
        """
        try:
            with files.storing("The dataset's last partition"):
                for mode_name in list(self._open):
                    self._seal(mode_name)
                self._save_all()
        except DatasetError as error:
            cause = error.__cause__
            if not (isinstance(cause, OSError) and cause.errno in files.FULL):
                raise
        finally:
            for partition in self._open.values():
                partition.close()
            self._open.clear()

    def _next(self, mode_name: str) -> OpenPartition:
        """Seal the full partition of a mode, if there is one, and begin the next."""
        sealed = mode_name in self._open
        if sealed:
            self._seal(mode_name)
        mode = self._manifest.modes[mode_name]
        partition = self._open[mode_name] = self._begin(mode_name, mode)
        if sealed:
            write_index(self._directory, self.session, self._manifest)
        return partition

    def _begin(self, mode_name: str, mode: Mode) -> OpenPartition:
        """Create the files of a partition, then list it; only then rows may be committed."""
        entry = Partition(self.session, self._free_index(mode_name, mode), mode.rows, writing=True)
        row_nbytes = max(1, *(field.nbytes for field in mode.fields.values()))
        capacity = max(1, self._max_nbytes // row_nbytes)
        parts: dict[str, PartitionFile] = {}
        try:
            for name, field in mode.fields.items():
                identity = entry.identity(mode_name, field)
                parts[name] = PartitionFile.create(self._directory, identity, capacity)
                entry.offsets[name] = parts[name].data_offset
            for part in parts.values():
                part.publish()
            mode.partitions.append(entry)
            self._manifest.save(self._directory)
        except BaseException:
            if entry in mode.partitions:
                mode.partitions.remove(entry)
            for part in parts.values():
                part.discard()
            raise
        return OpenPartition(entry, capacity, parts, self._durable)

    def _free_index(self, mode_name: str, mode: Mode) -> int:
        """Return the first number whose files do not exist yet."""
        used = [p.index for p in mode.partitions if p.session == self.session]
        entry = Partition(self.session, max(used, default=-1) + 1, 0)
        while any(
            (self._directory / entry.file_name(mode_name, name)).exists() for name in mode.fields
        ):
            entry = replace(entry, index=entry.index + 1)
        return entry.index

    def _seal(self, mode_name: str) -> None:
        """Seal the open partition of a mode, or remove it if it is empty."""
        mode, entry = self._manifest.modes[mode_name], self._open[mode_name].partition
        if entry.rows:
            with contextlib.suppress(DatasetError):  # an older partition is damaged: not now
                cover(self._reader, mode_name)
            seal(self._directory, mode_name, mode, entry)
        else:
            mode.partitions.remove(entry)
            remove_files(self._directory, mode_name, mode, entry)
        self._open.pop(mode_name).close()

    def _save_all(self) -> None:
        write_index(self._directory, self.session, self._manifest)
        self._manifest.save(self._directory)
