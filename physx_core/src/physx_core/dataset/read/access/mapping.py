"""Maps all partitions of a field into memory as one array; the system reads rows on access."""

from __future__ import annotations

import ctypes
import functools
import math
import mmap
import os
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from physx_core import files
from physx_core.dataset.store.partition.format import cannot_read, truncated
from physx_core.dataset.store.partition.segment import Segment
from physx_core.dataset.store.partition.spans import FlatIndex
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.packing import copy_ranges
from physx_core.typing import Array, Index

_FIXED = 0x10  # MAP_FIXED, which the module mmap does not define
_ANONYMOUS = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS


class Runs:
    """Runs of consecutive rows of an array as single values, which overlap.

    Indexing them is a single copy for each; `take` would copy all of them first.
    """

    def __init__(self) -> None:
        self._known: dict[int, Array] = {}

    def of(self, rows: Array, count: int) -> Array:
        """Return the runs from each row on, shape (runs,).

        Args:
            rows: Contiguous rows of at least one byte, at least `count` of them; always the same.
            count: How many follow one another.
        """
        found = self._known.get(count)
        if found is None:
            size = rows.nbytes // len(rows)
            run = np.dtype((np.void, count * size))
            found = np.ndarray((len(rows) - count + 1,), run, rows.data, 0, (size,))
            self._known[count] = found
        return found


class _Mapped(NamedTuple):
    path: str
    inode: tuple[int, int]
    start: int
    end: int


class MappedColumn:
    """A field on disk whose partitions are mapped one after another into the address space.

    The place of a row follows from that of its partition, so a batch is a single gather, however
    many partitions there are. Processes that map the same files share the page cache.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the rows.
    """

    def __init__(self, segments: Sequence[Segment], field: Field) -> None:
        """Map the partitions."""
        self.shape: tuple[int, ...] = (
            sum(segment.rows for segment in segments),
            *field.entry_shape,
        )
        self.dtype = np.dtype(field.dtype)
        self._row_nbytes = field.nbytes
        self._mapped: list[_Mapped] = []
        self._slots, slots = _places(segments, field.nbytes)
        self._index = FlatIndex([segment.span for segment in segments])
        self._single, self._runs = len(segments) == 1, Runs()
        if field.nbytes and slots:
            content = self._map(segments, slots * field.nbytes)
            self._array = content.view(self.dtype).reshape(slots, *self.shape[1:])
        else:
            self._array = np.empty((slots, *self.shape[1:]), self.dtype)

    def gather(self, index: Index, out: Array) -> None:
        """Copy the rows of an index array, all in range, into `out` of the field's own type."""
        if not self._single and len(index):
            numbers, places = self._index.locate(index)
            index = self._slots[numbers] + places
        self._array.take(index, 0, out, "clip")

    def copy(self, starts: Index, counts: Index, out: Array) -> None:
        """Copy runs of rows within partitions into an array of as many, at least one."""
        if not self._single:
            numbers, places = self._index.locate(starts)
            starts = self._slots[numbers] + places
        copy_ranges(self._array, starts, counts, out)

    def windows(self, first: Index, count: int) -> Array:
        """Return consecutive rows from each of some rows on, shape (n, count, *field shape)."""
        numbers, places = self._index.locate(first)
        ends, _ = self._index.locate(first + (count - 1))
        begins = self._slots[numbers] + places
        array = self._array
        if not self._row_nbytes or len(array) < count:
            return np.empty((len(first), count, *array.shape[1:]), array.dtype)
        runs = self._runs.of(array, count)
        found: Array = runs[np.minimum(begins, len(runs) - 1)].view(array.dtype)
        found = found.reshape(len(first), count, *array.shape[1:])
        apart = np.flatnonzero(numbers != ends)
        if len(apart):
            rows = first[apart, None] + np.arange(count)
            several = np.empty((rows.size, *array.shape[1:]), array.dtype)
            self.gather(rows.ravel(), several)
            found[apart] = several.reshape(len(apart), *found.shape[1:])
        return found

    def check(self) -> None:
        """Check that no file was truncated: the system kills a process that reads past the end."""
        for part in self._mapped:
            try:
                now = os.stat(part.path)  # noqa: PTH116 (quicker, and this is done often)
            except FileNotFoundError:
                continue  # a removed or replaced file stays intact while it is mapped
            if now.st_size < part.end and (now.st_dev, now.st_ino) == part.inode:
                path, size = Path(part.path), self._row_nbytes
                raise truncated(path, now.st_size, part.end, part.start, size)

    def _map(self, segments: Sequence[Segment], nbytes: int) -> NDArray[np.uint8]:
        base = _reserve(nbytes)
        weakref.finalize(self, _libc().munmap, base, nbytes).atexit = False
        for segment, slot in zip(segments, self._slots, strict=True):
            address = base + int(slot) * self._row_nbytes
            file, offset = segment.open()
            with file:
                count = segment.rows * self._row_nbytes
                try:
                    _place(address, count, file.fileno(), offset)
                except OSError as error:
                    raise cannot_read(segment.path, error) from error
                status = os.fstat(file.fileno())
            inode = status.st_dev, status.st_ino
            self._mapped.append(_Mapped(str(segment.path), inode, offset, offset + count))
        content = np.frombuffer(_bytes_at(base, nbytes), np.uint8)
        content.flags.writeable = False
        return content


def _places(segments: Sequence[Segment], row_nbytes: int) -> tuple[Index, int]:
    """Return the place of each segment's first row and the number of places in the array.

    Each segment begins at a page boundary and at a whole number of rows.
    """
    step = mmap.PAGESIZE // math.gcd(mmap.PAGESIZE, max(1, row_nbytes))
    slots, end = [], 0
    for segment in segments:
        end = -(-end // step) * step
        slots.append(end)
        end += segment.rows
    return np.array(slots, np.intp), end


def _place(address: int, count: int, descriptor: int, offset: int) -> None:
    """Map `count` bytes of a file to an address; copy them if they are not page-aligned."""
    if offset % mmap.PAGESIZE == 0:
        _mmap(address, count, mmap.PROT_READ, mmap.MAP_SHARED | _FIXED, descriptor, offset)
        return
    _mmap(address, count, mmap.PROT_READ | mmap.PROT_WRITE, _ANONYMOUS | _FIXED, -1, 0)
    if not files.read_at(descriptor, _bytes_at(address, count), offset):
        raise OSError(0, "it became shorter while it was being read")


def _bytes_at(address: int, count: int) -> memoryview:
    return memoryview((ctypes.c_ubyte * count).from_address(address)).cast("B")


def _reserve(nbytes: int) -> int:
    """Reserve address space without allocating memory."""
    noreserve = getattr(mmap, "MAP_NORESERVE", 0)
    try:
        return _mmap(None, nbytes, mmap.PROT_READ, _ANONYMOUS | noreserve, -1, 0)
    except OSError as error:
        raise DatasetError(
            f"Rows cannot be mapped: {error.strerror}. {nbytes} bytes of address space are needed. "
            "Raise the limit on the address space (ulimit -v), or read fewer fields."
        ) from error


def _mmap(
    address: int | None, nbytes: int, protection: int, flags: int, descriptor: int, offset: int
) -> int:
    found = _libc().mmap(address, nbytes, protection, flags, descriptor, offset)
    if found is None or found == ctypes.c_void_p(-1).value:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return int(found)


@functools.cache
def _libc() -> Any:
    library = ctypes.CDLL(None, use_errno=True)
    library.mmap.restype = ctypes.c_void_p
    library.mmap.argtypes = [
        ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_int64,
    ]  # fmt: skip
    library.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
    return library
