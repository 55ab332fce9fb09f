"""Writes partitions in another process than the one that keeps the manifest: see `delegation`."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from physx_core import files
from physx_core.closeable import Closeable
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.partition.file import PartitionFile
from physx_core.dataset.store.sealing import seal
from physx_core.dataset.store.syncing import Syncer
from physx_core.dataset.write.row_validation import stored_form
from physx_core.dataset.write.writer import OpenPartition
from physx_core.errors import DatasetError
from physx_core.fields import Field, ends_fields
from physx_core.processes import Helper
from physx_core.typing import Batch


class PartitionWriter(Closeable):
    """Writes rows to partitions that another process has begun; close it after use.

    Full ones are sealed in the background. Rows written by `append` survive if the process dies
    later, and after about a second also a power failure.

    Attributes:
        fields: The fields of the rows, and those of their free axes.
    """

    def __init__(
        self,
        directory: Path,
        fields: Sequence[Field],
        capacity: int,
        helper: Callable[[str], Helper[Any]] = Helper,
    ) -> None:
        """Start without a partition.

        Args:
            directory: The dataset's folder.
            fields: The fields of the rows, with their shapes.
            capacity: Number of rows that fit into a partition.
            helper: Makes what works beside the caller, given a name.
        """
        self._own = {field.name: field for field in fields}
        self.fields = [*fields, *ends_fields(fields).values()]
        self._capacity, self._directory = capacity, directory
        self._waiting: deque[Partition] = deque()
        self._opened: OpenPartition | None = None
        self._syncer = Syncer(helper("physx-sync"))
        self._digester: Helper[None] = helper("physx-digest")
        self._sealer: Helper[Partition] = helper("physx-seal")

    def add(self, entry: Partition) -> None:
        """Register the partition after the known ones."""
        self._waiting.append(entry)

    @property
    def room(self) -> int:
        """Number of rows that still fit into the known partitions."""
        free = 0 if self._opened is None else self._opened.free
        return free + len(self._waiting) * self._capacity

    def append(self, rows: Batch, count: int) -> int:
        """Write and commit rows that fit into `room`; return the address of the first one.

        Raises:
            DatasetError: If the disk is full or fails.
        """
        done, first, rows = 0, 0, stored_form(self._own, rows)
        with files.storing("The rows of this client"):
            self._syncer.check()
            while done < count:
                opened = self._opened = self._opened or self._open(self._waiting.popleft())
                entry, part = opened.partition, min(opened.free, count - done)
                if opened.fitting(rows, done, part) < part:
                    raise DatasetError(f"Partition {entry.index} has no space for more entries.")
                first = first if done else entry.first_row + entry.rows
                opened.append(rows, done, part)
                done += part
                if not opened.free:
                    self._retire(opened)
        return first

    def take_sealed(self, *, wait: bool = False) -> list[Partition]:
        """Return the partitions that have been sealed since the last call."""
        found = []
        with files.storing("A partition of this client"):
            while self._sealer.pending and (wait or self._sealer.is_ready):
                found.append(self._sealer.take())
        return found

    def close(self) -> None:
        """Sync and close the files."""
        self._sealer.close()
        self._digester.close()
        opened, self._opened = self._opened, None
        if opened is not None:
            opened.close()
        with files.storing("The last rows"):
            self._syncer.close()

    def _open(self, entry: Partition) -> OpenPartition:
        parts: dict[str, PartitionFile] = {}
        try:
            for field in self.fields:
                identity = entry.identity(field)
                parts[field.name] = PartitionFile.reopen(self._directory, identity, self._digester)
        except (OSError, DatasetError):
            for part in parts.values():
                part.close()
            raise
        return OpenPartition(entry, self._capacity, parts, self._syncer)

    def _retire(self, opened: OpenPartition) -> None:
        """Close a full partition and seal it in the background."""
        self._opened = None
        opened.close()
        fields = {field.name: field for field in self.fields}
        entry = replace(opened.partition)
        self._sealer.give(partial(seal, self._directory, fields, entry, statistics=False))
