"""The partition file: an ordinary HDF5 file whose rows are written without HDF5.

It holds contiguous datasets: ``data`` (capacity, *field shape); the scalar ``rows``, the number of
committed rows; ``commits``, the records that show which rows have reached the disk; and
``digests``, those of the blocks of rows. If the field has a free axis, its rows are the entries of
all samples, end to end; where those of each end is in a file of its own. Its attributes state what
it is part of; ``header`` repeats that, with a digest of everything that never changes. h5py creates
all of it once, in memory; after that, rows are written at known file offsets, so that HDF5 never
runs while samples arrive, and h5py can open the file at any time.
"""

from __future__ import annotations

import errno
import io
import json
import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from xxhash import xxh3_64_intdigest

from physx_core import files
from physx_core.dataset.store.partition.commits import (
    COUNT,
    DIGEST,
    NBYTES,
    RECORDS,
    SECTOR,
    Commit,
    Kept,
    RowLayout,
    block_ends,
    boot_id,
    decode,
    encode,
    find_kept,
)
from physx_core.dataset.store.validation import SESSION, checked, parse_field, parse_name, whole
from physx_core.errors import DatasetError, PhysxError
from physx_core.fields import Field

FORMAT = "physx partition"
VERSION = 4
MAGIC = b"\x89physx\r\n"
"""Start of the dataset ``header``, which physx reads without HDF5."""
SIGNATURE = b"\x89HDF\r\n\x1a\n"
SPARE = 64
"""A sealed file has space for one entry of a free axis more for each so many, at most."""
_PAGE = 4096
_NUMBERS = struct.Struct("<6QI")  # digest and size of the header, offsets, capacity, length of text
_ALIGNMENT = 16  # no number in a row crosses a sector boundary
_COMMON_HEADER = 2**14
_LARGEST_HEADER = 2**20
_INVALID = (
    OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError,
    MemoryError, struct.error, PhysxError,
)  # fmt: skip
"""Errors that reading and parsing raise for bytes that are not a header."""
_END_OF_FILE = 40  # offset of the file's size in an HDF5 superblock of version 0


@dataclass(frozen=True)
class Identity:
    """The partition and field that a partition file belongs to.

    Attributes:
        session: Session that wrote it.
        mode: Mode of its rows.
        field: Its field, with a known shape.
        index: Number of the partition in its session and mode, counted from 0.
        first_row: Address of the partition's first row in the mode.
    """

    session: str
    mode: str
    field: Field
    index: int
    first_row: int

    @property
    def file_name(self) -> str:
        """Name of the file."""
        return partition_file(self.session, self.mode, self.field.name, self.index)

    @property
    def attributes(self) -> dict[str, str | int]:
        """The file's attributes."""
        return {
            "format": FORMAT,
            "format_version": VERSION,
            "session": self.session,
            "mode": self.mode,
            "field": self.field.name,
            "partition": self.index,
            "unit": self.field.unit,
            "role": self.field.role,
            "first_row": self.first_row,
        }


@dataclass(frozen=True)
class Header:
    """The bytes that HDF5 needs in a partition file, and where the rows go.

    Attributes:
        content: Beginning of the file; the rows may begin before its end.
        rows_offset: Offset of the committed row count, which the records follow.
        table_offset: Offset of the digests of the blocks.
        data_offset: Offset of the first row.
        capacity: Number of rows that fit in.
        size: Size of the whole file in bytes.
    """

    content: bytes
    rows_offset: int
    table_offset: int
    data_offset: int
    capacity: int
    size: int


@dataclass(frozen=True)
class Inspection:
    """Contents of a partition file's header.

    Attributes:
        identity: Its identity.
        capacity: Number of rows that fit in.
        rows: Number of committed rows.
        rows_offset: Offset of the committed row count.
        table_offset: Offset of the digests of the blocks.
        data_offset: Offset of the first row.
        table: The digests of the blocks.
        commits: The records of committed rows, newest first.
        boot: `boot_id` when the file was created.
    """

    identity: Identity
    capacity: int
    rows: int
    rows_offset: int
    table_offset: int
    data_offset: int
    table: bytes
    commits: tuple[Commit, ...]
    boot: str

    @property
    def was_off(self) -> bool:
        """Whether the machine may have been off since the file was created."""
        return not self.boot == boot_id() != ""

    @property
    def is_consistent(self) -> bool:
        """Whether the row count is that of the newest record, as each commit leaves them."""
        return self.rows == self.commits[0].rows

    def is_sealed_form(self, rows: int) -> bool:
        """Whether a sealed file with so many rows may be like this: it has space for no others.

        Entries of a free axis rarely fill a file: a little space may be left, for to copy all of
        them would cost more than to write them did.
        """
        spare = rows // SPARE if self.identity.field.free_axis else 0
        return self.rows == rows <= self.capacity <= rows + spare

    @property
    def certain(self) -> bool:
        """Whether all counted rows can be read because the machine has not been off since."""
        return self.is_consistent and not self.was_off


def partition_file(session: str, mode: str, field: str, index: int) -> str:
    """Return the name of a partition file."""
    return f"{session}_{mode}_{field}_{index}.h5"


def hdf5_type(field: Field) -> np.dtype[Any]:
    """Return a field's type as h5py stores it: text as strings of fixed length in UTF-8."""
    import h5py

    kind = field.numpy_dtype
    return h5py.string_dtype("utf-8", kind.itemsize) if field.is_text else kind


def make_header(identity: Identity, capacity: int, rows: int = 0) -> Header:
    """Make the header of a partition file with h5py.

    Args:
        identity: Identity of the file.
        capacity: Number of rows that fit in.
        rows: Number of committed rows to record in the header.
    """
    import h5py
    from h5py import h5d, h5p, h5s, h5t

    field = identity.field
    layout = h5p.create(h5p.DATASET_CREATE)
    layout.set_layout(h5d.CONTIGUOUS)
    layout.set_alloc_time(h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5d.FILL_TIME_NEVER)
    kind = h5t.py_create(hdf5_type(field), logical=True)
    image = io.BytesIO()
    with h5py.File(
        image,
        "w",
        libver=("earliest", "v110"),
        alignment_threshold=2048,
        alignment_interval=_PAGE,
    ) as file:
        for name, value in identity.attributes.items():
            file.attrs[name] = value
        description = _describe(identity)
        block = len(MAGIC) + _NUMBERS.size + len(description)
        scalar, table = h5s.create(h5s.SCALAR), h5s.create_simple((RECORDS, len(Commit._fields)))
        counter = h5d.create(file.id, b"rows", h5t.STD_U64LE, scalar, layout)
        records = h5d.create(file.id, b"commits", h5t.STD_U64LE, table, layout)
        own = h5d.create(file.id, b"header", h5t.STD_U8LE, h5s.create_simple((block,)), layout)
        blocks = len(block_ends(field.nbytes, capacity))
        digests = h5d.create(
            file.id, b"digests", h5t.STD_U64LE, h5s.create_simple((blocks,)), layout
        )
        space = h5s.create_simple((capacity, *field.entry_shape))
        layout.set_alloc_time(h5d.ALLOC_TIME_LATE)  # after everything that HDF5 needs
        data = h5d.create(file.id, b"data", kind, space, layout)
        if capacity * field.nbytes:
            origin, one = (0,) * len(data.shape), (1,) * len(data.shape)
            space.select_hyperslab(origin, one)
            data.write(h5s.create_simple(one), space, np.zeros(one, field.dtype), kind)
        rows_offset, data_offset = counter.get_offset(), data.get_offset() or 0
        own_offset, records_offset = own.get_offset(), records.get_offset()
        table_offset = digests.get_offset() or 0
    if (
        records_offset != rows_offset + COUNT.size
        or rows_offset // SECTOR != (rows_offset + NBYTES - 1) // SECTOR
    ):
        raise RuntimeError("HDF5 has put the row count and the records into different sectors.")
    content = bytearray(image.getvalue())
    content[rows_offset : rows_offset + NBYTES] = encode(Commit.unchecked(rows))
    nbytes = len(content)
    numbers = rows_offset, table_offset, data_offset, capacity, len(description)
    filled = MAGIC + _NUMBERS.pack(0, nbytes, *numbers) + description
    content[own_offset : own_offset + block] = filled
    content[table_offset : table_offset + blocks * DIGEST.size] = bytes(blocks * DIGEST.size)
    changing = _changing(rows_offset, table_offset, data_offset, capacity, field.nbytes)
    digest = _digest_header(content, own_offset, changing)
    _NUMBERS.pack_into(content, own_offset + len(MAGIC), digest, nbytes, *numbers)
    size = max(len(content), data_offset + capacity * field.nbytes)
    return Header(bytes(content), rows_offset, table_offset, data_offset, capacity, size)


def inspect(path: Path, offset: int | None = None, row_nbytes: int = 0) -> Inspection:
    """Read the header of a partition file.

    Args:
        path: The file.
        offset: Where its rows begin, if known; only for error messages.
        row_nbytes: Bytes of one row; only for error messages.
    """
    with open_partition(path) as file:
        return inspect_open(file, path, offset, row_nbytes)


def find_rows(
    path: Path, offset: int | None, row_nbytes: int, *, thorough: bool
) -> tuple[Inspection, Kept | None]:
    """Read the header of an unsealed partition file and find the rows that count.

    They are None if all records of the file are damaged.

    Args:
        path: The file.
        offset: Where its rows begin, if known; only for error messages.
        row_nbytes: Bytes of one row; only for error messages.
        thorough: Whether to always compare the rows with the file's digests; otherwise only if the
            machine has been off since they were written.
    """
    with open_partition(path) as file:
        before = None
        while True:
            found = inspect_open(file, path, offset, row_nbytes)
            nbytes = found.identity.field.nbytes
            rows = RowLayout(found.data_offset, nbytes, found.capacity, found.table)
            if found.certain and not thorough:
                return found, Kept(found.commits[0], rows)
            try:
                kept = find_kept(file.fileno(), rows, found.commits, certain=found.certain)
            except OSError as error:
                raise cannot_read(path, error) from error
            if found == before or (kept is not None and not kept.damaged):
                return found, kept
            before = found  # a writer may have just updated rows


def open_partition(path: Path) -> io.FileIO:
    """Open a partition file for reading."""
    try:
        return io.FileIO(str(path), opener=files.open_regular)
    except FileNotFoundError:
        raise DatasetError(
            f"The partition {path.name} is missing from {path.parent}. Restore it: without it, "
            "this partition's rows cannot be read in any field."
        ) from None
    except OSError as error:
        raise cannot_read(path, error) from error


def cannot_read(path: Path, error: OSError) -> DatasetError:
    """Return the error for a partition file that the system cannot open, map or read."""
    full = error.errno in (errno.EMFILE, errno.ENFILE)
    advice = " Raise the limit on open files (ulimit -n)." if full else ""
    return DatasetError(f"The partition {path} cannot be read: {error.strerror}.{advice}")


def inspect_open(
    file: io.FileIO, path: Path, offset: int | None = None, row_nbytes: int = 0
) -> Inspection:
    """Return the header of an open partition file, as `inspect` does."""
    _check_superblock(file, path, offset, row_nbytes)
    try:
        head = _read_header(file.fileno())
        found = _parse_header(head)
    except _INVALID as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise DatasetError(f"{path} is damaged or not a dataset's partition: {reason}.") from error
    size, field = files.size(file.fileno()), found.identity.field
    expected = found.data_offset + found.capacity * field.nbytes
    if size < expected:
        raise truncated(path, size, expected, found.data_offset, field.nbytes)
    return found


def truncated(path: Path, actual: int, expected: int, offset: int, row_nbytes: int) -> DatasetError:
    """Return the error for a partition file that is shorter than its rows."""
    kept = max(0, actual - offset) // row_nbytes if row_nbytes else 0
    return DatasetError(
        f"The partition {path} is truncated: it has {actual} bytes, but {expected} were expected. "
        f"{kept} rows of this file are left. Restore the whole file from a backup."
    )


def _check_superblock(file: io.FileIO, path: Path, offset: int | None, row_nbytes: int) -> None:
    head = os.pread(file.fileno(), 48, 0)
    if not head.startswith(SIGNATURE):
        raise DatasetError(f"{path} is damaged or not a dataset's partition: it is not HDF5.")
    actual = os.fstat(file.fileno()).st_size
    expected = int.from_bytes(head[_END_OF_FILE : _END_OF_FILE + 8], "little")
    if head[8] == 0 and actual < expected:
        raise truncated(path, actual, expected, _PAGE if offset is None else offset, row_nbytes)


def _describe(identity: Identity) -> bytes:
    plain = {
        "format": FORMAT,
        "format_version": VERSION,
        "session": identity.session,
        "mode": identity.mode,
        "field": identity.field.to_dict(),
        "partition": identity.index,
        "first_row": identity.first_row,
        "boot": boot_id(),
    }
    text = json.dumps(plain).encode()
    return text + b" " * (-(len(MAGIC) + _NUMBERS.size + len(text)) % _ALIGNMENT)


def _read_header(descriptor: int) -> bytes:
    """Return the first bytes of a file, enough for its header."""
    head = files.read_head(descriptor, _COMMON_HEADER)
    start = head.find(MAGIC) + len(MAGIC)
    found = start >= len(MAGIC) and start + _NUMBERS.size <= len(head)
    if found and _NUMBERS.unpack_from(head, start)[1] <= len(head):
        return head
    return files.read_head(descriptor, _LARGEST_HEADER)


def _parse_header(head: bytes) -> Inspection:
    """Return the header in the first bytes of a file.

    HDF5 never parses them: the remains of a header after a power failure may make it loop forever.
    """
    start = head.find(MAGIC)
    if start < 0:
        raise ValueError("it has no physx header")
    numbers = _NUMBERS.unpack_from(head, start + len(MAGIC))
    digest, nbytes, rows_offset, table_offset, data_offset, capacity, length = numbers
    for number in numbers[1:]:
        whole(number, "a number of its header")
    begin = start + len(MAGIC) + _NUMBERS.size
    if nbytes > len(head) or begin + length > nbytes or rows_offset + NBYTES > nbytes:
        raise ValueError("its header is incomplete")
    plain = json.loads(head[begin : begin + length])
    version = whole(plain["format_version"], "the format's version")
    if version != VERSION:
        raise ValueError(f"its format has version {version}; this physx reads {VERSION}")
    field = parse_field(plain["field"])
    if field.shape is None:
        raise ValueError("the shape of its field is missing")
    whole(data_offset + capacity * field.nbytes, "the end of its rows")
    changing = _changing(rows_offset, table_offset, data_offset, capacity, field.nbytes)
    if changing[1][1] > nbytes:
        raise ValueError("its header is incomplete")
    if _digest_header(head[:nbytes], start, changing) != digest:
        raise ValueError("its header does not match its checksum")
    session = checked(str, plain["session"], "a session")
    if not SESSION.fullmatch(session):
        raise ValueError(f"a session cannot be {session!r:.60}")
    identity = Identity(
        session,
        parse_name(plain["mode"], "a mode"),
        field,
        whole(plain["partition"], "the number of a partition", 2**31),
        whole(plain["first_row"], "a first row"),
    )
    rows, commits = decode(head[rows_offset : rows_offset + NBYTES])
    boot = checked(str, plain["boot"], "'boot'")
    rows = min(rows, capacity)
    table = head[slice(*changing[1])]
    return Inspection(
        identity, capacity, rows, rows_offset, table_offset, data_offset, table, commits, boot
    )


def _changing(
    rows_offset: int, table_offset: int, data_offset: int, capacity: int, row_nbytes: int
) -> tuple[tuple[int, int], ...]:
    """Return the start and end of what changes in a file: records, digests of blocks, rows."""
    table_nbytes = len(block_ends(row_nbytes, capacity)) * DIGEST.size
    return (
        (rows_offset, rows_offset + NBYTES),
        (table_offset, table_offset + table_nbytes),
        (data_offset, data_offset + capacity * row_nbytes),
    )


def _digest_header(
    content: bytes | bytearray, start: int, changing: tuple[tuple[int, int], ...]
) -> int:
    """Return the digest of a header, excluding the digest itself and what changes."""
    fixed = bytearray(content)
    place = start + len(MAGIC)
    for first, last in ((place, place + 8), *changing):
        fixed[first:last] = bytes(len(fixed[first:last]))
    return int(xxh3_64_intdigest(fixed))
