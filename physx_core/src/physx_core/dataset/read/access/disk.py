"""Reads a field's rows from its files on demand, and announces reads to the operating system."""

from __future__ import annotations

import itertools
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
        self.shape: tuple[int, ...] = (reader.stored_rows(mode), *(field.shape or ()))
        self.dtype = field.converted_dtype(dtype)
        self.row_nbytes = field.nbytes
        self._own = np.dtype(field.dtype)
        self._scratch = np.empty((0, *self.shape[1:]), self._own)
        self._segments = reader.segments(mode, name)
        self._index = FlatIndex([segment.span for segment in self._segments])
        self._opened: dict[int, tuple[FileIO, int]] = {}

    def announce(self, index: Index) -> None:
        """Tell the operating system that rows will be read soon.

        Args:
            index: The rows, shape (n,); consecutive ones are announced together.
        """
        size = self.row_nbytes
        if not size or not hasattr(os, "posix_fadvise"):
            return
        for start, stop in _runs(index):
            for number, first, part, _ in self._parts(int(index[start]), stop - start):
                file, offset = self._open(number)
                place = offset + first * size
                os.posix_fadvise(file.fileno(), place, part * size, os.POSIX_FADV_WILLNEED)

    def gather(self, index: Index, out: Array) -> None:
        """Copy rows into a contiguous array, shape (rows, *field shape).

        Args:
            index: The rows, shape (n,); consecutive ones are read together.
            out: Receives them.
        """
        rows = self._target(out)
        for start, stop in _runs(index):
            target = rows[start:stop]
            for number, first, _, where in self._parts(int(index[start]), stop - start):
                self._read(number, first, files.as_bytes(target[where]))
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

    def _read(self, number: int, first: int, view: memoryview) -> None:
        """Fill a buffer with the rows of a segment from its row `first` on."""
        if view:
            file, offset = self._open(number)
            self._segments[number].read(file, offset + first * self.row_nbytes, view)

    def _parts(self, start: int, count: int) -> Iterator[tuple[int, int, int, slice]]:
        """Locate `count` rows of the mode, from `start` on, in the segments.

        Yields:
            Segment number, first row there, number of rows, and their places among the `count`.
        """
        if not count:
            return
        number, place, follow = self._index.find(start)
        if count <= follow:
            yield number, place, count, slice(0, count)
            return
        stop = start + count
        while number < len(self._segments) and self._segments[number].span.start < stop:
            span = self._segments[number].span
            first, part = span.inside(start, stop)
            if part:
                yield number, first, part, span.among(first, part, start)
            number += 1

    def _open(self, number: int) -> tuple[FileIO, int]:
        """Return the open file of a segment and the offset of its first row."""
        found = self._opened.get(number)
        if found is None:
            if len(self._opened) >= _OPEN_FILES:
                self._opened.pop(next(iter(self._opened)))[0].close()
            found = self._opened[number] = self._segments[number].open()
        return found


def _runs(index: Index) -> Iterator[tuple[int, int]]:
    """Yield where each run of consecutive rows begins, and where it ends."""
    ends = np.flatnonzero(np.diff(index) != 1) + 1
    return itertools.pairwise([0, *ends.tolist(), len(index)]) if len(index) else iter(())
