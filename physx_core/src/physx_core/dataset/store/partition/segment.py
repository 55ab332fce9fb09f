"""Reads the committed rows of one field from one partition file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.dataset.store.partition.commits import Kept, Range
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
        kept: Record and digests of its rows and perhaps some more, if the partition is open and
            was left by its writer.
    """

    path: Path
    field: Field
    span: Span
    offset: int
    certain: bool
    checksum: int | None = None
    kept: Kept | None = None

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
        buffer = np.empty((min(count, self.rows), *self.field.entry_shape), self.field.numpy_dtype)
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
    """Compares all rows of a segment, given in order, with their checksum or digests."""

    def __init__(self, segment: Segment) -> None:
        self._checksum, self._kept, self._rows = segment.checksum, segment.kept, segment.rows
        self._crc, self._unchecked = 0, 0
        if self._kept is not None:
            base = self._kept.commit.base
            self._digests = self._kept.rows.begin(base)
            self._unchecked = base * segment.field.nbytes

    def add(self, part: memoryview) -> None:
        """Add the next rows."""
        if self._checksum is not None:
            self._crc = crc32(part, self._crc)
        elif self._kept is not None:
            self._digests.update(part[self._unchecked :])
            self._unchecked = max(0, self._unchecked - len(part))

    @property
    def passed(self) -> bool:
        """Whether the added rows are those of the segment."""
        if self._checksum is not None:
            return self._crc == self._checksum
        return not self.damaged

    @property
    def damaged(self) -> list[Range]:
        """The rows in the blocks that do not match their digests, if digests are known."""
        if self._checksum is not None or self._kept is None:
            return []
        return self._kept.rows.differences(self._digests, self._kept.commit, self._rows)


def rows_per_block(row_nbytes: int, nbytes: int = BLOCK) -> int:
    """Return the number of rows, at least 1, in a block of about `nbytes` bytes."""
    return max(1, nbytes // max(1, row_nbytes))
