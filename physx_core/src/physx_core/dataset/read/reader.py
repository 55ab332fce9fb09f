"""Reading rows from the partitions of a field, which lie behind one flat index."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np

from physx_core import files
from physx_core.dataset.store.checksums import crc32
from physx_core.dataset.store.manifest import Manifest, Mode
from physx_core.dataset.store.partition_format import (
    SIGNATURE,
    inspect_open,
    open_partition,
    truncated,
)
from physx_core.errors import DatasetError, listed, nearest
from physx_core.fields import Field
from physx_core.typing import Array

_BLOCK = 2**20


@dataclass(frozen=True)
class Segment:
    """The rows of one field in one partition.

    Attributes:
        path: The file.
        start: Row of the mode that is the first one here.
        rows: How many rows to read.
        offset: Where they begin in the file.
        certain: Whether `offset` holds; otherwise the file itself is asked, because another
            process may replace it by its final form at any moment.
        checksum: CRC-32 of all its rows; None where it is not known.
    """

    path: Path
    start: int
    rows: int
    offset: int
    certain: bool
    checksum: int | None = None

    def open(self, row_nbytes: int) -> tuple[FileIO, int]:
        """Open the file; return it with the place of the first row.

        Args:
            row_nbytes: Bytes of one row.

        Raises:
            DatasetError: The file is missing, truncated or damaged.
        """
        file = open_partition(self.path)
        try:
            offset = self.offset
            if not self.certain:
                offset = inspect_open(file, self.path, offset, row_nbytes).data_offset
            size = os.fstat(file.fileno()).st_size
            expected = offset + self.rows * row_nbytes
            if size < expected:
                raise truncated(self.path, size, expected, offset, row_nbytes)
            if os.pread(file.fileno(), len(SIGNATURE), 0) != SIGNATURE:
                raise DatasetError(f"{self.path} is damaged: it is no HDF5 file any more.")
        except BaseException:
            file.close()
            raise
        return file, offset


class Reader:
    """Reads the committed rows that a manifest knows of."""

    def __init__(self, directory: Path, manifest: Manifest) -> None:
        self.directory = directory
        self._manifest = manifest

    def mode(self, mode: str) -> Mode:
        """Return a mode.

        Raises:
            DatasetError: There is no such mode, or its rows cannot be counted.
        """
        modes = self._manifest.modes
        if mode not in modes:
            raise DatasetError(
                f'The dataset in {self.directory} has no mode "{mode}".{nearest(mode, modes)} '
                f"Modes: {listed(modes)}."
            )
        if mode in self._manifest.problems:
            raise self._manifest.problems[mode]
        return modes[mode]

    def field(self, mode: str, name: str) -> Field:
        """Return a field of a mode.

        Raises:
            DatasetError: The mode has no such field.
        """
        fields = self.mode(mode).fields
        if name not in fields:
            raise DatasetError(
                f'Mode "{mode}" has no field "{name}".{nearest(name, fields)} '
                f"Fields: {listed(fields)}."
            )
        return fields[name]

    def rows(self, mode: str) -> int:
        """Return the number of committed rows of a mode."""
        return self.mode(mode).rows

    def segments(self, mode: str, name: str) -> list[Segment]:
        """Return where the rows of a field lie, in their order."""
        found, start = [], 0
        for partition in self.mode(mode).partitions:
            if partition.rows:
                found.append(
                    Segment(
                        self.directory / partition.file_name(mode, name),
                        start,
                        partition.rows,
                        partition.offsets.get(name, 0),
                        partition.sealed or partition.writing,
                        partition.checksums.get(name),
                    )
                )
            start += partition.rows
        return found

    def read(self, mode: str, name: str, start: int, stop: int) -> Array:
        """Return rows as a new array, shape (stop - start, *field shape).

        Raises:
            DatasetError: A partition is missing, truncated or damaged.
        """
        field = self.field(mode, name)
        if (stop - start) * field.nbytes > _BLOCK:
            self.check(mode, name, start, stop)
        out = np.empty((max(0, stop - start), *(field.shape or ())), field.dtype)
        self.read_into(out, mode, name, start)
        return out

    def check(self, mode: str, name: str, start: int = 0, stop: int | None = None) -> None:
        """Check that the files have the rows, before memory is taken for rows that are not there.

        Raises:
            DatasetError: A partition is missing, truncated or damaged.
        """
        size = self.field(mode, name).nbytes
        for segment in self.segments(mode, name):
            if start < segment.start + segment.rows and (stop is None or segment.start < stop):
                segment.open(size)[0].close()

    def read_into(
        self,
        out: Array,
        mode: str,
        name: str,
        start: int,
        sums: dict[int, int] | None = None,
    ) -> None:
        """Fill a contiguous array of the field's type with the rows from `start` on.

        Sealed partitions that are read as a whole are compared with their checksums.

        Args:
            out: Gets the rows.
            mode: Name of the mode.
            name: Name of the field.
            start: First row.
            sums: Checksums of partitions that are read in several calls, kept from one to the next.

        Raises:
            DatasetError: A partition is missing, truncated or damaged.
        """
        size, stop = self.field(mode, name).nbytes, start + len(out)
        if not size:
            return
        view = files.raw(out)
        for segment in self.segments(mode, name):
            first = max(start, segment.start)
            count = min(stop, segment.start + segment.rows) - first
            if count <= 0:
                continue
            part = view[(first - start) * size : (first - start + count) * size]
            file, offset = segment.open(size)
            with file:
                place = offset + (first - segment.start) * size
                if not files.read_at(file.fileno(), part, place):
                    raise DatasetError(f"{segment.path} became shorter while it was read.")
            _compare(segment, first, count, part, {} if sums is None else sums)

    def blocks(self, mode: str, name: str, start: int = 0) -> Iterator[Array]:
        """Yield all rows from `start` on in blocks of about a megabyte, each valid until the next.

        Raises:
            DatasetError: A partition is missing, truncated or damaged.
        """
        field, total = self.field(mode, name), self.rows(mode)
        count = max(1, _BLOCK // max(1, field.nbytes))
        buffer = np.empty((min(count, max(0, total - start)), *(field.shape or ())), field.dtype)
        sums: dict[int, int] = {}
        for first in range(start, total, count):
            block = buffer[: total - first]
            self.read_into(block, mode, name, first, sums)
            yield block


def _compare(
    segment: Segment, first: int, count: int, part: memoryview, sums: dict[int, int]
) -> None:
    """Add rows to the checksum of their segment, and compare it when they are the last ones."""
    if segment.checksum is None or (first > segment.start and segment.start not in sums):
        return
    crc = crc32(part, sums.pop(segment.start, 0))
    if first + count < segment.start + segment.rows:
        sums[segment.start] = crc
    elif crc != segment.checksum:
        raise DatasetError(
            f"{segment.path} was changed or is damaged: its rows have checksum {crc:08x}, not "
            f"{segment.checksum:08x}. Put it back from a copy, or set it aside with "
            "`physx verify --repair`."
        )
