"""Commits: how many rows of a partition file count, and what tells that they reached the disk.

A writer's rows and its row count lie in different pages of the file, which the system brings to
the disk in any order: after a power cut, the count may speak of rows that are not there. So each
file keeps three records beside the count, in one sector of the disk: the newest commit, and two
marks. A mark is made of the newest commit before the file is synced, in turn, so that one of them
always speaks of rows that a completed sync has brought to the disk. A record's digest tells whether
its rows are those that were written.
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
"""Bytes of the row count and the records behind it."""
SECTOR = 512
"""Bytes that a disk writes as a whole, or not at all."""

_NO_DIGEST = xxh3_64_intdigest(b"")
_BLOCK = 2**20


class Commit(NamedTuple):
    """A record of committed rows.

    Attributes:
        rows: How many of the file's first rows are committed.
        base: The rows before this one have no digest, because they may be updated in place; they
            were on the disk before the record was made.
        digest: XXH3 of the bytes of rows `base` to `rows`, 64 bits.
    """

    rows: int
    base: int
    digest: int

    @classmethod
    def unchecked(cls, rows: int) -> Commit:
        """Return a record of rows that have no digest."""
        return cls(rows, rows, _NO_DIGEST)


def encode(commit: tuple[int, int, int]) -> bytes:
    """Return the row count and the records when all records are the same."""
    return COUNT.pack(commit[0]) + RECORD.pack(*commit) * RECORDS


def decode(content: bytes) -> tuple[int, tuple[Commit, ...]]:
    """Return the row count and the records, the newest first."""
    records = RECORD.iter_unpack(content[COUNT.size :])
    return COUNT.unpack_from(content)[0], tuple(Commit(*record) for record in records)


def find_intact(
    descriptor: int, data_offset: int, row_nbytes: int, commits: Iterable[Commit]
) -> Commit | None:
    """Return the record of most rows that the file really holds; None if it holds those of none.

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
    """Return the digest of some bytes of a file; None if it does not have them."""
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
    """Return what changes when the machine starts; empty where the system does not tell.

    Everything that a process has written since then can be read, whether it has reached the disk
    or not.
    """
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""
