"""Reads a field's rows from its files on demand, and announces reads to the operating system."""

from __future__ import annotations

import os
from collections.abc import Iterator
from io import FileIO
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store.partition.spans import FlatIndex
from physx_core.typing import Array, Index

_OPEN_FILES = 64

Piece = tuple[int, int, int, int]
"""Segment, first row there, number of rows, and the place of the first among the sought ones."""
Pieces = list[Piece]


class DiskColumn:
    """The stored rows of a field on disk; close it after use.

    Rows are read with system calls, not through mapped memory: a file that becomes shorter raises
    an error instead of killing the process, and the memory of the process does not grow. Reading
    raises a `DatasetError` if a partition is missing, truncated or damaged, or the disk fails.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the returned rows.
        row_nbytes: Bytes of one stored row.
    """

    def __init__(self, reader: Reader, mode: str, name: str, dtype: np.dtype[Any] | None) -> None:
        """Look up where the currently committed rows are stored.

        Args:
            reader: Provides the partitions.
            mode: Name of the mode.
            name: Name of the field.
            dtype: Type that floating-point rows are converted to; None: no conversion.
        """
        field = reader.field(mode, name)
        self.shape: tuple[int, ...] = (reader.stored_rows(mode), *field.entry_shape)
        self.dtype = field.converted_dtype(dtype)
        self.row_nbytes = field.nbytes
        self._own = np.dtype(field.dtype)
        self._scratch = np.empty((0, *self.shape[1:]), self._own)
        self._segments = reader.segments(mode, name)
        self._index = FlatIndex([segment.span for segment in self._segments])
        self._opened: dict[int, tuple[FileIO, int]] = {}

    def announce(self, pieces: Pieces) -> None:
        """Tell the operating system that rows will be read soon.

        Args:
            pieces: The rows.
        """
        size = self.row_nbytes
        if not size or not hasattr(os, "posix_fadvise"):
            return
        for number, first, count, _ in pieces:
            file, offset = self._open(number)
            start = offset + first * size
            os.posix_fadvise(file.fileno(), start, count * size, os.POSIX_FADV_WILLNEED)

    def gather(self, index: Index, out: Array, pieces: Pieces | None = None) -> None:
        """Copy rows into a contiguous array, shape (rows, *field shape).

        Args:
            index: The rows, shape (n,); consecutive ones are read together.
            out: Receives them.
            pieces: The rows, if any field of the mode has located them already.
        """
        rows, size = self._target(out), self.row_nbytes
        view = files.as_bytes(rows)
        if pieces is None:
            pieces = self.locate(index)
        for number, first, count, at in pieces if size else ():
            file, offset = self._open(number)
            part = view[at * size : (at + count) * size]
            self._segments[number].read(file, offset + first * size, part)
        if rows is not out:
            out[...] = rows

    def close(self) -> None:
        """Close the files; reading opens them again."""
        for file, _ in self._opened.values():
            file.close()
        self._opened.clear()

    def _target(self, out: Array) -> Array:
        """Return an array of the field's own type to read into."""
        if out.dtype == self._own:
            return out
        if len(self._scratch) < len(out):
            self._scratch = np.empty(out.shape, self._own)
        return self._scratch[: len(out)]

    def locate(self, index: Index) -> Pieces:
        """Locate rows in the segments, consecutive ones together; the same for all fields."""
        return list(self._pieces(index)) if len(index) else []

    def _pieces(self, index: Index) -> Iterator[Piece]:
        begins = np.append(0, np.flatnonzero(np.diff(index) != 1) + 1)
        counts = np.diff(begins, append=len(index))
        numbers, firsts = self._index.locate(index[begins])
        ends, _ = self._index.locate(index[begins] + counts - 1)
        columns = (each.tolist() for each in (numbers, ends, firsts, counts, begins))
        for number, end, first, count, at in zip(*columns, strict=True):
            while number != end and count:  # it goes on in the next one
                part = min(count, self._segments[number].rows - first)
                if part:
                    yield number, first, part, at
                number, first, count, at = number + 1, 0, count - part, at + part
            yield number, first, count, at

    def _open(self, number: int) -> tuple[FileIO, int]:
        """Return the open file of a segment and the offset of its first row."""
        found = self._opened.get(number)
        if found is None:
            if len(self._opened) >= _OPEN_FILES:
                self._opened.pop(next(iter(self._opened)))[0].close()
            found = self._opened[number] = self._segments[number].open()
        return found
