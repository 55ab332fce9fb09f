"""Writes the file of one field in the open partition."""

from __future__ import annotations

import errno
import os
import struct
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.dataset.store.partition.commits import (
    COUNT,
    DIGEST,
    RECORD,
    Commit,
    Range,
    RowLayout,
    encode,
)
from physx_core.dataset.store.partition.format import Header, Identity, inspect, make_header
from physx_core.errors import DatasetError
from physx_core.processes import Helper
from physx_core.typing import Array

_LARGE = 2**17  # bytes from which hashing beside the copying into the cache takes no extra time
_SMALLEST_STEP = 2**20
_LARGEST_STEP = 2**26
_COPY = 2**23
_NEWEST = struct.Struct("<4Q")  # the row count and the newest record


class PartitionFile:
    """Writes rows to their offsets and commits them with the row count.

    Another thread may `mark` and sync the file at the same time.

    Attributes:
        identity: Identity of the file.
        capacity: Number of rows that fit in.
        data_offset: Offset of the first row.
        descriptor: The open file; -1 if it is closed.
        path: Its path once it is published.
        room: Number of rows with allocated disk space.
        committed: The newest commit: rows, base and digest, as in `Commit`.
    """

    def __init__(
        self,
        path: Path,
        identity: Identity,
        header: Header,
        descriptor: int,
        digester: Helper[None],
    ) -> None:
        self.identity = identity
        self.capacity = header.capacity
        self.data_offset = header.data_offset
        self.path = path
        self.committed: tuple[int, int, int] = Commit.unchecked(0)
        self._rows = RowLayout(header.data_offset, identity.field.nbytes, header.capacity, b"")
        self._digests, self._digester = self._rows.begin(0), digester
        self._next_mark = 0
        self._lock = threading.Lock()
        self._row_nbytes = identity.field.nbytes
        self._rows_offset, self._table_offset = header.rows_offset, header.table_offset
        self._size = header.size
        self._reserved = len(header.content)
        self.room = 0
        self.descriptor = descriptor

    @classmethod
    def create(
        cls, directory: Path, identity: Identity, capacity: int, digester: Helper[None]
    ) -> PartitionFile:
        """Write an empty partition file under a temporary name and wait until it is on disk.

        Args:
            directory: The dataset's folder.
            identity: Identity of the file.
            capacity: Number of rows that fit in.
            digester: Computes the digests of large blocks.
        """
        header = make_header(identity, capacity)
        path = directory / identity.file_name
        descriptor = _write_header(files.temporary_path(path), header)
        file = cls(path, identity, header, descriptor, digester)
        try:
            file.sync()
        except OSError:
            file.discard()
            raise
        return file

    @classmethod
    def reopen(cls, directory: Path, identity: Identity, digester: Helper[None]) -> PartitionFile:
        """Open a partition file that another process has created, to write its first rows.

        Args:
            directory: The dataset's folder.
            identity: Expected identity of the file.
            digester: Computes the digests of large blocks.

        Raises:
            DatasetError: If the file has a different identity or has rows.
        """
        path = directory / identity.file_name
        descriptor = files.open_regular(path, os.O_RDWR)
        try:
            found = inspect(path)
            if found.identity != identity or found.rows:
                raise DatasetError(f"{path} is not the empty partition to be written.")
        except BaseException:
            files.close(descriptor)
            raise
        size = found.data_offset + found.capacity * identity.field.nbytes
        header = Header(
            b"", found.rows_offset, found.table_offset, found.data_offset, found.capacity, size
        )
        return cls(path, identity, header, descriptor, digester)

    def publish(self) -> None:
        """Rename the file to its final name."""
        files.rename(files.temporary_path(self.path), self.path)

    def discard(self) -> None:
        """Close and remove the file, whether or not it is published."""
        self.close()
        files.remove(files.temporary_path(self.path))
        files.remove(self.path)

    def reserve(self, rows: int) -> None:
        """Allocate disk space for the first `rows` rows and some more."""
        needed = self.data_offset + rows * self._row_nbytes
        step = min(max(self._reserved, _SMALLEST_STEP), _LARGEST_STEP)
        ample = min(max(needed, self._reserved + step), self._size)
        try:
            self._allocate(ample)
        except OSError as error:
            if error.errno in (errno.EOPNOTSUPP, errno.EINVAL):  # not supported here
                self._reserved = self._size
                self._allocate(self._size)
            elif error.errno in files.FULL:
                self._allocate(needed)
            else:
                raise

    def append(self, row: int, block: Array, rows: int, *, durable: bool) -> None:
        """Write rows, and make the first `rows` rows of the file part of the dataset.

        Args:
            row: Number of the first one in the file.
            block: Contiguous rows of the field's own type, shape (count, *field shape).
            rows: Number of rows of the file, including these.
            durable: Whether the caller syncs the file before it continues.
        """
        digests, nbytes = self._digests, block.nbytes
        pieces: list[tuple[bytes | memoryview, int]] = []
        offset = self.data_offset + row * self._row_nbytes
        if nbytes < digests.left and nbytes < _LARGE:
            digests.left -= nbytes
            digests.running.update(block.data)
            pieces.append((block.data, offset))
        else:
            self._write(block, offset)
        before = self.committed
        commit = rows, before[1], digests.running.intdigest()
        content = _NEWEST.pack(rows, *commit)
        if durable:
            first, second = (before, commit) if self._next_mark else (commit, before)
            content += RECORD.pack(*first) + RECORD.pack(*second)
            self._next_mark = 1 - self._next_mark
        pieces.append((content, self._rows_offset))
        files.write_pieces(self.descriptor, pieces)
        self.committed = commit

    def withdraw(self, commit: tuple[int, int, int]) -> None:
        """Return to an earlier commit, whatever has been written since.

        Args:
            commit: The commit; its digest is recomputed.
        """
        self._digester.drain()
        rows, base, _ = commit
        with self._lock:
            found = self._rows.digests_of(self.descriptor, base, rows)
            self._digests = self._rows.begin(rows) if found is None else found
            self._store_digests()
            self.committed = rows, base, self._digests.running.intdigest()
            files.sync(self.descriptor)
            files.write_at(self.descriptor, encode(self.committed), self._rows_offset)
            files.sync(self.descriptor)

    def is_checked(self, row: int) -> bool:
        """Return whether the digest covers a row; if so, call `settle` before updating it."""
        return row >= self.committed[1]

    def mark(self) -> int:
        """Copy the newest commit to a mark, to be brought to disk by the next sync.

        Returns:
            A duplicate descriptor for syncing the file; -1 if the file is closed.
        """
        with self._lock:
            if self.descriptor < 0:
                return -1
            place = COUNT.size + RECORD.size * (1 + self._next_mark)
            content = RECORD.pack(*self.committed)
            files.write_at(self.descriptor, content, self._rows_offset + place)
            self._next_mark = 1 - self._next_mark
            return files.duplicate(self.descriptor)

    def settle(self) -> None:
        """Sync all rows and remove their digest, so that they may be updated."""
        with self._lock:
            files.sync(self.descriptor)
            settled = Commit.unchecked(self.committed[0])
            files.write_at(self.descriptor, encode(settled), self._rows_offset)
            files.sync(self.descriptor)
            self.committed, self._digests = settled, self._rows.begin(settled.rows)

    def sync(self) -> None:
        """Wait until everything written is on disk."""
        sync_named(self.descriptor, self.path)

    def close(self) -> None:
        """Close the file; calling it again does nothing."""
        if self.descriptor >= 0:
            with self._lock:
                descriptor, self.descriptor = self.descriptor, -1
            files.close(descriptor)

    def _write(self, block: Array, offset: int) -> None:
        """Write rows that complete a block of rows with a digest, or a large block."""
        content = files.as_bytes(block)
        if len(content) < _LARGE:
            self._digests.update(content)
        else:
            self._digester.give(partial(self._digests.update, content))
        files.write_at(self.descriptor, content, offset)
        self._digester.drain()
        if self._digests.finished:  # they must be there before rows that rely on them
            self._store_digests()

    def _store_digests(self) -> None:
        first, content = self._digests.take()
        files.write_at(self.descriptor, content, self._table_offset + first * DIGEST.size)

    def _allocate(self, end: int) -> None:
        if end > self._reserved:
            files.reserve(self.descriptor, self._reserved, end)
            self._reserved = end
        self.room = (self._reserved - self.data_offset) // max(1, self._row_nbytes)


def copy(
    source: Path,
    source_offset: int,
    path: Path,
    identity: Identity,
    rows: int,
    without: Sequence[Range] = (),
) -> tuple[int, int]:
    """Copy rows of a partition file to a new one, which gets its final name once it is complete.

    Args:
        source: The other file.
        source_offset: Offset of its first row.
        path: The new file; an existing one is replaced, even the source itself.
        identity: Its identity.
        rows: Number of rows of the other file, from the first.
        without: Which of them are left out, in order.

    Returns:
        Offset of the first row in the new file, and the CRC-32 of the rows.
    """
    nbytes = identity.field.nbytes
    parts = complement(rows, without)
    count = sum(stop - start for start, stop in parts)
    header = make_header(identity, count, count)
    draft = files.temporary_path(path)
    descriptor = _write_header(draft, header)
    try:
        try:
            crc, place = 0, header.data_offset
            for start, stop in parts:
                part = (stop - start) * nbytes
                crc = _copy(source, source_offset + start * nbytes, descriptor, place, part, crc)
                place += part
            files.sync(descriptor)
        finally:
            files.close(descriptor)
        files.rename(draft, path)
    except OSError:
        files.remove(draft)
        raise
    return header.data_offset, crc


def sync_named(descriptor: int, path: Path) -> None:
    """Wait until an open file is on disk, and check that it has not been removed."""
    files.sync(descriptor)
    if files.is_removed(descriptor):
        raise files.RemovedError(errno.ENOENT, "it was removed", str(path))


def _write_header(path: Path, header: Header) -> int:
    descriptor = files.create_new(path)
    try:
        files.resize(descriptor, header.size)
        files.write_at(descriptor, header.content, 0)
    except OSError:
        files.close(descriptor)
        files.remove(path)
        raise
    return descriptor


def complement(rows: int, without: Sequence[Range]) -> list[Range]:
    """Return which of the first rows are in none of some ranges, which are in order."""
    starts, stops = [0, *(stop for _, stop in without)], [*(start for start, _ in without), rows]
    return [(start, stop) for start, stop in zip(starts, stops, strict=True) if start < stop]


def _copy(
    source: Path, source_offset: int, target: int, target_offset: int, count: int, crc: int
) -> int:
    """Copy bytes; return the CRC-32 of them and of what had `crc`."""
    buffer, done = memoryview(bytearray(min(count, _COPY))), 0
    with files.opened(source) as origin:
        while done < count:
            part = buffer[: count - done]
            here, there = source_offset + done, target_offset + done
            shared = files.copy_range(origin, here, target, there, len(part))
            descriptor, offset = (target, there) if shared else (origin, here)
            if not files.read_at(descriptor, part, offset):
                raise OSError(errno.EIO, f"{source} became shorter while it was being read")
            if not shared:
                files.write_at(target, part, there)
            crc, done = crc32(part, crc), done + len(part)
    return crc
