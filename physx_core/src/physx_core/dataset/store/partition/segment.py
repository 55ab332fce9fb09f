"""Reads the committed rows of one field from one partition file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np
from xxhash import xxh3_64
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.dataset.store.partition.commits import Commit
from physx_core.dataset.store.partition.format import (
    SIGNATURE,
    cannot_read,
    inspect_open,
    open_partition,
    truncated,
)
from physx_core.dataset.store.partition.spans import Span
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.typing import Array

BLOCK = 2**20
"""Approximate size in bytes of the blocks that rows are read in."""


@dataclass(frozen=True)
class Segment:
    """The committed rows of one field in one partition.

    Attributes:
        path: The file.
        field: The field, with a known shape.
        span: Which rows of the mode they are.
        offset: Byte of the file at which they begin.
        certain: Whether `offset` can be relied on; otherwise it is read from the file, because
            another process may replace the file with its final form at any time.
        checksum: CRC-32 of all its rows; None if unknown.
        commit: Record of all its rows, if the partition is open and was left by its writer.
    """

    path: Path
    field: Field
    span: Span
    offset: int
    certain: bool
    checksum: int | None = None
    commit: Commit | None = None

    @property
    def rows(self) -> int:
        """Number of rows to read."""
        return self.span.rows

    def open(self) -> tuple[FileIO, int]:
        """Open the file; return it with the offset of the first row."""
        file = open_partition(self.path)
        try:
            offset, row_nbytes = self.offset, self.field.nbytes
            if not self.certain:
                offset = inspect_open(file, self.path, offset, row_nbytes).data_offset
            size = os.fstat(file.fileno()).st_size
            expected = offset + self.rows * row_nbytes
            if size < expected:
                raise truncated(self.path, size, expected, offset, row_nbytes)
            if os.pread(file.fileno(), len(SIGNATURE), 0) != SIGNATURE:
                raise DatasetError(f"{self.path} is damaged: it is no longer an HDF5 file.")
        except BaseException:
            file.close()
            raise
        return file, offset

    def read(self, file: FileIO, offset: int, view: memoryview) -> None:
        """Fill a buffer from the open file."""
        try:
            complete = files.read_at(file.fileno(), view, offset)
        except OSError as error:
            raise cannot_read(self.path, error) from error
        if not complete:
            raise DatasetError(f"{self.path} became shorter while it was being read.")

    def blocks(self) -> Iterator[Array]:
        """Yield all rows in blocks of about a megabyte, each valid until the next."""
        row_nbytes = self.field.nbytes
        count = rows_per_block(row_nbytes)
        buffer = np.empty((min(count, self.rows), *(self.field.shape or ())), self.field.dtype)
        file, offset = self.open()
        with file:
            for first in range(0, self.rows, count):
                block = buffer[: self.rows - first]
                self.read(file, offset + first * row_nbytes, files.as_bytes(block))
                yield block

    def compute_checksum(self) -> int:
        """Return the CRC-32 of all rows.

        zlib-ng computes it several times faster than Python's zlib and lets other threads run.
        """
        crc = 0
        for block in self.blocks():
            crc = crc32(files.as_bytes(block), crc)
        return crc


class RowsCheck:
    """Compares all rows of a segment, given in order, with their checksum or digest."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._crc, self._digest = 0, xxh3_64()
        self._unchecked = segment.commit.base * segment.field.nbytes if segment.commit else 0

    def add(self, part: memoryview) -> None:
        """Add the next rows."""
        if self._segment.checksum is not None:
            self._crc = crc32(part, self._crc)
        elif self._segment.commit is not None:
            self._digest.update(part[self._unchecked :])
            self._unchecked = max(0, self._unchecked - len(part))

    @property
    def passed(self) -> bool:
        """Whether the added rows are those of the segment."""
        wanted, commit = self._segment.checksum, self._segment.commit
        if wanted is not None:
            return self._crc == wanted
        return commit is None or self._digest.intdigest() == commit.digest


def rows_per_block(row_nbytes: int, nbytes: int = BLOCK) -> int:
    """Return the number of rows, at least 1, in a block of about `nbytes` bytes."""
    return max(1, nbytes // max(1, row_nbytes))
