"""Reads a field's rows from its files as they are needed, and announces them to the system."""

from __future__ import annotations

import os
from bisect import bisect_right
from io import FileIO
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.strategies.cache import converted_dtype
from physx_core.typing import Array, Index

_OPEN_FILES = 64


class DiskColumn:
    """A field on the disk; close it after use.

    Rows are read with system calls, not through mapped memory: a file that becomes shorter raises
    an error instead of killing the process, and the memory of the process does not grow. Reading
    raises a `DatasetError` if a partition is missing, truncated or damaged, or the disk fails.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the rows that are returned.
        row_nbytes: Bytes of one stored row.
    """

    def __init__(self, reader: Reader, mode: str, name: str, dtype: np.dtype[Any] | None) -> None:
        """Look up where the rows that are committed now are stored.

        Args:
            reader: Knows the partitions.
            mode: Name of the mode.
            name: Name of the field.
            dtype: Type that floating rows are converted to; None: their own.
        """
        field = reader.field(mode, name)
        self.shape: tuple[int, ...] = (reader.rows(mode), *(field.shape or ()))
        self.dtype = converted_dtype(field, dtype)
        self.row_nbytes = field.nbytes
        self._own = np.dtype(field.dtype)
        self._scratch = np.empty((0, *self.shape[1:]), self._own)
        self._segments = reader.segments(mode, name)
        self._starts = [segment.start for segment in self._segments]
        self._opened: dict[int, tuple[FileIO, int]] = {}

    def announce(self, start: int, count: int = 1) -> None:
        """Tell the system that `count` rows from `start` on will be read soon."""
        size = self.row_nbytes
        if not size or not hasattr(os, "posix_fadvise"):
            return
        while count > 0:
            number, place, part = self._locate(start, count)
            descriptor = self._opened[number][0].fileno()
            os.posix_fadvise(descriptor, place, part * size, os.POSIX_FADV_WILLNEED)
            start, count = start + part, count - part

    def gather(self, index: Index, out: Array) -> None:
        """Copy single rows into a contiguous array, shape (rows, *field shape)."""
        size, rows = self.row_nbytes, self._target(out)
        view = files.as_bytes(rows)
        for number, row in enumerate(index.tolist()):
            self._read(row, 1, view[number * size : (number + 1) * size])
        if rows is not out:
            out[...] = rows

    def slice(self, start: int, out: Array) -> None:
        """Copy consecutive rows into a contiguous array, shape (rows, *field shape)."""
        rows = self._target(out)
        self._read(start, len(rows), files.as_bytes(rows))
        if rows is not out:
            out[...] = rows

    def close(self) -> None:
        """Close the files; reading opens them again."""
        for file, _ in self._opened.values():
            file.close()
        self._opened.clear()

    def _target(self, out: Array) -> Array:
        """Return where rows of the field's own type can be read to."""
        if out.dtype == self._own:
            return out
        if len(self._scratch) < len(out):
            self._scratch = np.empty(out.shape, self._own)
        return self._scratch[: len(out)]

    def _read(self, row: int, count: int, view: memoryview) -> None:
        size = self.row_nbytes
        while view:
            number, place, part = self._locate(row, count)
            file = self._opened[number][0]
            self._segments[number].read(file, place, view[: part * size])
            row, count, view = row + part, count - part, view[part * size :]

    def _locate(self, row: int, count: int) -> tuple[int, int, int]:
        """Return a row's opened segment, its offset, and how many of `count` rows follow there."""
        number = bisect_right(self._starts, row) - 1
        segment, found = self._segments[number], self._opened.get(number)
        if found is None:
            if len(self._opened) >= _OPEN_FILES:
                self._opened.pop(next(iter(self._opened)))[0].close()
            found = self._opened[number] = segment.open()
        before = row - segment.start
        return number, found[1] + before * self.row_nbytes, min(count, segment.rows - before)
