"""Commits: how many rows of a partition file count, and how to tell that they reached the disk.

A writer's rows and its row count are in different pages of the file, which the system writes to
disk in any order: after a power failure, the count may include rows that are missing. Each file
therefore keeps three records next to the count, in the same disk sector: the newest commit and two
marks. Before each sync of the file, the newest commit is copied to one of the marks, alternately,
so that one of them always covers rows that a completed sync has brought to disk. A record's digest
shows whether the file's rows are the ones that were written.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from xxhash import xxh3_64, xxh3_64_intdigest

from physx_core import files

RECORDS = 3
"""The newest commit and two marks."""
RECORD = struct.Struct("<3Q")
COUNT = struct.Struct("<Q")
NBYTES = COUNT.size + RECORDS * RECORD.size
"""Bytes of the row count and the records after it."""
SECTOR = 512
"""Number of bytes that a disk writes atomically."""

_NO_DIGEST = xxh3_64_intdigest(b"")
_BLOCK = 2**20


class Commit(NamedTuple):
    """A record of committed rows.

    Attributes:
        rows: Number of committed rows, from the beginning of the file.
        base: Rows before this one have no digest because they may be updated in place; they were
            on disk before the record was made.
        digest: 64-bit XXH3 of the bytes of rows `base` to `rows`.
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


def find_intact(
    descriptor: int, data_offset: int, row_nbytes: int, commits: Iterable[Commit]
) -> Commit | None:
    """Return the record with the most rows that the file actually holds; None if there is none.

    Args:
        descriptor: The open file.
        data_offset: Offset of its first row.
        row_nbytes: Bytes of one row.
        commits: The file's records.
    """
    for commit in sorted(set(commits), reverse=True):
        start, stop = (data_offset + row * row_nbytes for row in (commit.base, commit.rows))
        digest = digest_of(descriptor, start, stop)
        if digest is not None and digest.intdigest() == commit.digest:
            return commit
    return None


def digest_of(descriptor: int, start: int, stop: int) -> xxh3_64 | None:
    """Return the digest of some bytes of a file; None if the file lacks them."""
    if start > stop or stop > files.size(descriptor):
        return None
    digest, buffer = xxh3_64(), memoryview(bytearray(min(stop - start, _BLOCK)))
    for place in range(start, stop, _BLOCK):
        part = buffer[: stop - place]
        if not files.read_at(descriptor, part, place):
            return None
        digest.update(part)
    return digest


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
