"""Writes one stripe of a mode's rows, in a process other than the one that keeps the manifest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from physx_core import files
from physx_core.closeable import Closeable
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.partition.file import PartitionFile
from physx_core.dataset.store.sealing import seal
from physx_core.dataset.store.syncing import Syncer
from physx_core.dataset.write.writer import OpenPartition
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.processes import Helper
from physx_core.typing import Batch


class StripeWriter(Closeable):
    """Writes and seals the partitions of one stripe in order; close it after use.

    Rows written by `append` survive if the process dies later, and after about a second also a
    power failure.

    Attributes:
        rows: Number of rows of the stripe, in all its partitions.
        fields: The fields of the rows.
        capacity: Number of rows that fit into a partition.
    """

    def __init__(self, directory: Path, fields: Sequence[Field], capacity: int) -> None:
        """Start without a partition.

        Args:
            directory: The dataset's folder.
            fields: The fields of the rows, with their shapes.
            capacity: Number of rows that fit into a partition.
        """
        self.rows = 0
        self.fields = list(fields)
        self.capacity, self._directory = capacity, directory
        self._fields = {field.name: field for field in fields}
        self._entries: dict[int, Partition] = {}
        self._opened: OpenPartition | None = None
        self._syncer = Syncer(Helper("physx-sync"))
        self._digester = Helper[None]("physx-digest")
        self._sealer = Helper[tuple[int, Partition]]("physx-seal")

    def add(self, number: int, entry: Partition) -> None:
        """Register the partition for the rows from ``number * capacity`` on."""
        self._entries[number] = entry

    def resume(self, told: int) -> int:
        """Continue a stripe that another process has begun.

        The rows of its unsealed partitions are compared with their digests.

        Args:
            told: Number of rows it is supposed to have; the actual number may be larger or, if
                rows were lost, smaller.

        Returns:
            Number of rows it has.
        """
        self.rows = told
        with files.storing("The rows of an earlier process"):
            for number, entry in sorted(self._entries.items()):
                begin = number * self.capacity
                rows = self._count(entry)
                self.rows = begin + rows
                self._opened = self._open(number, rows)
                if self._opened.free:
                    break
                self._retire()
        return self.rows

    @property
    def room(self) -> int:
        """Number of rows that still fit into the known partitions."""
        known = (max(self._entries) + 1) * self.capacity if self._entries else 0
        return max(0, known - self.rows)

    def append(self, rows: Batch, count: int) -> None:
        """Write and commit rows that fit into `room`.

        Raises:
            DatasetError: If the disk is full or fails; `rows` says how many are stored.
        """
        done = 0
        with files.storing("The rows of this client"):
            self._syncer.check()
            while done < count:
                if self._opened is None:
                    self._opened = self._open(self.rows // self.capacity, 0)
                part = min(self._opened.free, count - done)
                self._opened.append(rows, done, part)
                done, self.rows = done + part, self.rows + part
                if not self._opened.free:
                    self._retire()

    def take_sealed(self, *, wait: bool = False) -> list[tuple[int, Partition]]:
        """Return the partitions that have been sealed since the last call, with their numbers."""
        found = []
        with files.storing("A partition of this client"):
            while self._sealer.pending and (wait or self._sealer.is_ready):
                try:
                    found.append(self._sealer.take())
                except OSError as error:
                    if error.errno not in files.FULL:  # else it is sealed once there is space
                        raise
        return found

    def finish(self, rows: int) -> list[tuple[int, Partition]]:
        """Seal the last partition and return all that have been sealed since the last call.

        Args:
            rows: Number of rows to keep in the stripe; rows of earlier partitions always stay.
        """
        if self._opened is not None:
            number = (self.rows - self._opened.partition.rows) // self.capacity
            keep = min(max(0, rows - number * self.capacity), self._opened.partition.rows)
            if keep:
                self._retire(keep)
        return self.take_sealed(wait=True)

    def close(self) -> None:
        """Sync and close the files without sealing them."""
        self._sealer.close()
        self._digester.close()
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()
        with files.storing("The last rows"):
            self._syncer.close()

    def _count(self, entry: Partition) -> int:
        """Return the number of rows before the first lost or damaged one of any field."""
        found = []
        for field in self.fields:
            _, kept = entry.find_rows(self._directory, field, thorough=True)
            if kept is None:
                return 0
            found += [kept.commit.rows, *(start for start, _ in kept.damaged)]
        return min(found)

    def _open(self, number: int, rows: int) -> OpenPartition:
        entry = replace(self._entries[number], rows=rows)
        parts: dict[str, PartitionFile] = {}
        try:
            for field in self.fields:
                parts[field.name] = PartitionFile.reopen(
                    self._directory, entry.identity(field), rows, self._digester
                )
        except (OSError, DatasetError):
            for part in parts.values():
                part.close()
            raise
        return OpenPartition(entry, self.capacity, parts, self._syncer)

    def _retire(self, rows: int | None = None) -> None:
        """Close the open partition and seal it in the background."""
        opened = self._opened
        if opened is None:
            return
        self._opened, entry = None, opened.partition
        number = (self.rows - entry.rows) // self.capacity
        opened.close()
        entry = replace(entry, rows=entry.rows if rows is None else rows)
        self._sealer.give(lambda: (number, seal(self._directory, self._fields, entry)))
