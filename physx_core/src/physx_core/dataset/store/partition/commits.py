"""Commits: how many rows of a partition file count, and how to tell that they reached the disk.

A writer's rows and its row count are in different pages of the file, which the system writes to
disk in any order: after a power failure, the count may include rows that are missing. Each file
therefore keeps three records next to the count, in the same disk sector: the newest commit and two
marks. Before each sync of the file, the newest commit is copied to one of the marks, alternately,
so that one of them always covers rows that a completed sync has brought to disk. Digests show
whether the file's rows are the ones that were written: each block of rows has one in a table, which
is written when the block is full, and a record has that of the rows after the last full block.

Rows that do not match are either lost, because they had not reached the disk, or damaged, because
their bits have changed since. Only rows after those of the older mark can be lost, and only if the
machine has been off since the file was created; all other rows have been seen on the disk.
"""

from __future__ import annotations

import functools
import struct
import sys
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from xxhash import xxh3_64, xxh3_64_intdigest

from physx_core import files

RECORDS = 3
"""The newest commit and two marks."""
RECORD = struct.Struct("<3Q")
COUNT = struct.Struct("<Q")
DIGEST = struct.Struct("<Q")
NBYTES = COUNT.size + RECORDS * RECORD.size
"""Bytes of the row count and the records after it."""
SECTOR = 512
"""Number of bytes that a disk writes atomically."""

_NO_DIGEST = xxh3_64_intdigest(b"")
_READ = 2**20
_SHARE = 32
_SHOWN = 5
_NEVER = sys.maxsize

Range = tuple[int, int]
"""Rows from the first one up to, not including, the second one."""


class Commit(NamedTuple):
    """A record of committed rows.

    Attributes:
        rows: Number of committed rows, from the beginning of the file.
        base: Rows before this one have no digest because they may be updated in place; they were
            on disk before the record was made.
        digest: 64-bit XXH3 of the bytes of those rows from `base` on that are in no full block.
    """

    rows: int
    base: int
    digest: int

    @classmethod
    def unchecked(cls, rows: int) -> Commit:
        """Return a record of rows without a digest."""
        return cls(rows, rows, _NO_DIGEST)


def encode(commit: tuple[int, int, int]) -> bytes:
    """Return the bytes of the row count and the records, with all records equal to `commit`."""
    return COUNT.pack(commit[0]) + RECORD.pack(*commit) * RECORDS


def decode(content: bytes) -> tuple[int, tuple[Commit, ...]]:
    """Return the row count and the records, newest first."""
    records = RECORD.iter_unpack(content[COUNT.size :])
    return COUNT.unpack_from(content)[0], tuple(Commit(*record) for record in records)


@functools.lru_cache(64)
def block_ends(row_nbytes: int, capacity: int) -> tuple[int, ...]:
    """Return the row after each block of a file that has a digest of its own.

    A block has at most 1/32 of the bytes before it, but at least one row, and a sector: a damaged
    one costs few rows, and the digests of all blocks take a few kilobytes.

    Args:
        row_nbytes: Bytes of one row.
        capacity: Number of rows that fit in.
    """
    ends, end = [], 0
    while end < capacity:
        rows = max(SECTOR, end * row_nbytes // _SHARE) // row_nbytes if row_nbytes else capacity
        end = min(end + max(1, rows), capacity)
        ends.append(end)
    return tuple(ends)


class BlockDigests:
    """Computes the digests of consecutive rows by block.

    Attributes:
        first: Number of the block of the first of the `finished` digests.
        finished: Digests of the blocks that have become full since they were last taken.
        running: Digest of the rows after the last full block.
        left: Number of bytes that their block lacks; fewer may be added to `running` directly.
    """

    def __init__(self, row_nbytes: int, ends: Sequence[int], row: int) -> None:
        """Begin at a row.

        Args:
            row_nbytes: Bytes of one row.
            ends: The row after each block.
            row: Number of the first row.
        """
        self._row_nbytes, self._ends = row_nbytes, ends
        self.first = self._block = bisect_right(ends, row)
        self.finished: list[int] = []
        self.running, self.left = xxh3_64(), self._nbytes_from(row)

    def update(self, content: bytes | memoryview) -> None:
        """Add the bytes of the next rows."""
        view = memoryview(content)
        while len(view) >= self.left:
            self.running.update(view[: self.left])
            self.finished.append(self.running.intdigest())
            view = view[self.left :]
            row, self._block = self._ends[self._block], self._block + 1
            self.running, self.left = xxh3_64(), self._nbytes_from(row)
        self.left -= len(view)
        self.running.update(view)

    def take(self) -> tuple[int, bytes]:
        """Return the number of the first block of `finished` and its digests, and begin anew."""
        first, content = self.first, b"".join(map(DIGEST.pack, self.finished))
        self.first, self.finished = self._block, []
        return first, content

    def _nbytes_from(self, row: int) -> int:
        """Return the number of bytes from a row to the end of its block."""
        if not self._row_nbytes or self._block >= len(self._ends):
            return _NEVER
        return (self._ends[self._block] - row) * self._row_nbytes


@dataclass(frozen=True)
class RowLayout:
    """Where the rows of a partition file are, and the digests of its full blocks.

    Attributes:
        data_offset: Offset of the first row.
        row_nbytes: Bytes of one row.
        capacity: Number of rows that fit in.
        table: Digests of the blocks as stored.
    """

    data_offset: int
    row_nbytes: int
    capacity: int
    table: bytes

    @property
    def ends(self) -> tuple[int, ...]:
        """The row after each block."""
        return block_ends(self.row_nbytes, self.capacity)

    def begin(self, row: int) -> BlockDigests:
        """Return what computes the digests from a row on."""
        return BlockDigests(self.row_nbytes, self.ends, row)

    def digests_of(self, descriptor: int, start: int, stop: int) -> BlockDigests | None:
        """Return the digests of rows `start` to `stop` of a file; None if it lacks some."""
        begin, end = (self.data_offset + row * self.row_nbytes for row in (start, stop))
        if start > stop or end > files.size(descriptor):
            return None
        digests, buffer = self.begin(start), memoryview(bytearray(min(end - begin, _READ)))
        for place in range(begin, end, _READ):
            part = buffer[: end - place]
            if not files.read_at(descriptor, part, place):
                return None
            digests.update(part)
        return digests

    def differences(self, found: BlockDigests, commit: Commit, rows: int) -> list[Range]:
        """Return the rows of the blocks whose digests differ from the stored ones.

        Args:
            found: Digests of the rows from the record's base on.
            commit: The record.
            rows: The row after the last one of `found`: that of the record, or an earlier one,
                whose last block is then not compared.
        """
        ends, different = self.ends, []
        for number, digest in enumerate(found.finished, found.first):
            if DIGEST.unpack_from(self.table, number * DIGEST.size)[0] != digest:
                start = ends[number - 1] if number else 0
                different.append((max(start, commit.base), ends[number]))
        last = found.first + len(found.finished)
        start = max(ends[last - 1] if last else 0, commit.base)
        if rows == commit.rows > start and found.running.intdigest() != commit.digest:
            different.append((start, commit.rows))
        return different


@dataclass(frozen=True)
class Kept:
    """The rows that count in a partition file that its writer left open.

    Attributes:
        commit: The record of them.
        rows: The file's rows and digests.
        damaged: Which of them do not match their digests although they had been stored.
    """

    commit: Commit
    rows: RowLayout
    damaged: tuple[Range, ...] = ()


def find_kept(
    descriptor: int, rows: RowLayout, commits: Sequence[Commit], *, certain: bool
) -> Kept | None:
    """Return which rows of a file count; None if none of its records can be right.

    Args:
        descriptor: The open file.
        rows: Where the rows are.
        commits: The file's records, newest first.
        certain: Whether all rows of the newest record have been stored; otherwise only those of the
            older mark have.
    """
    possible = [c for c in sorted(set(commits), reverse=True) if c.base <= c.rows <= rows.capacity]
    stored = commits[0].rows if certain else min(commit.rows for commit in commits[1:])
    for commit in possible:
        digests = rows.digests_of(descriptor, commit.base, commit.rows)
        if digests is None:
            continue
        different = rows.differences(digests, commit, commit.rows)
        if all(stop <= stored for _, stop in different):
            _spare(descriptor, rows, commit, possible, different)
            return Kept(commit, rows, tuple(different))
    return None


def _spare(
    descriptor: int,
    rows: RowLayout,
    commit: Commit,
    others: Sequence[Commit],
    different: list[Range],
) -> None:
    """Spare the rows of the last block that an older record proves, if that block differs."""
    start, stop = different[-1] if different else (0, 0)
    for other in others:
        if stop == commit.rows and start < other.rows < stop and other.base == commit.base:
            digests = rows.digests_of(descriptor, start, other.rows)
            if digests is not None and digests.running.intdigest() == other.digest:
                different[-1] = other.rows, stop
                return


def merge_ranges(ranges: Iterable[Range]) -> list[Range]:
    """Return the union of ranges of rows, in order."""
    merged: list[Range] = []
    for start, stop in sorted(ranges):
        if merged and start <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(stop, merged[-1][1])
        else:
            merged.append((start, stop))
    return merged


def within(ranges: Sequence[Range], rows: int) -> list[Range]:
    """Return the parts of ranges that are among the first rows."""
    return [(start, min(stop, rows)) for start, stop in ranges if start < rows]


def name_rows(ranges: Sequence[Range]) -> str:
    """Return ranges of rows of a partition as text: ``rows 5 to 9 and 20 to 39``."""
    shown = [f"{start} to {stop - 1}" for start, stop in ranges[:_SHOWN]]
    more = [f"{len(ranges) - _SHOWN} more ranges"] if len(ranges) > _SHOWN else []
    return "rows " + " and ".join([*shown, *more])


@functools.cache
def boot_id() -> str:
    """Return an identifier of the machine's current boot; empty if the system does not provide it.

    Everything that a process has written since that boot can be read, whether or not it has reached
    the disk.
    """
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
