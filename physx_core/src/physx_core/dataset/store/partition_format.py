"""The partition file: an ordinary HDF5 file whose rows are written without HDF5.

It holds three contiguous datasets: ``data`` (capacity, *field shape), the scalar ``rows``, the
number of committed rows, and ``commits``, the records that tell which rows have reached the disk.
Its attributes say what it is part of. h5py makes the header once, in memory; from then on rows are
written at known offsets of the file, so that HDF5 never runs while samples arrive, and h5py can
open the file at any moment.
"""

from __future__ import annotations

import errno
import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.store.commits import (
    COUNT,
    NBYTES,
    RECORDS,
    SECTOR,
    Commit,
    boot_id,
    find_intact,
)
from physx_core.errors import DatasetError, PhysxError
from physx_core.fields import Field

FORMAT = "physx partition"
VERSION = 2
READABLE = (1, 2)
"""Versions of the partition file that can be read; those of version 1 have no ``commits``."""
UNREADABLE = (
    OSError, RuntimeError, LookupError, TypeError, ValueError, ArithmeticError, AttributeError,
    MemoryError,
)  # fmt: skip
"""What h5py raises for damaged files."""
SIGNATURE = b"\x89HDF\r\n\x1a\n"
_PAGE = 4096
_END_OF_FILE = 40  # where the file's size stands in an HDF5 superblock of version 0


@dataclass(frozen=True)
class Identity:
    """What a partition file is part of.

    Attributes:
        session: Session that wrote it.
        mode: Mode of its rows.
        field: Its field, with a known shape.
        index: Number of the partition in its session and mode, counted from 0.
        first_row: Row of the mode that is the partition's first.
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
        rows_offset: Offset of the committed row count, behind which the records lie.
        data_offset: Offset of the first row.
        size: Size of the whole file in bytes.
    """

    content: bytes
    rows_offset: int
    data_offset: int
    size: int


@dataclass(frozen=True)
class Inspection:
    """What a partition file says of itself.

    Attributes:
        identity: What it is part of.
        capacity: How many rows fit in.
        rows: How many rows are committed.
        data_offset: Offset of the first row.
        commits: The records of committed rows, the newest first.
        boot: What `boot_id` returned when the file was made.
    """

    identity: Identity
    capacity: int
    rows: int
    data_offset: int
    commits: tuple[Commit, ...] = ()
    boot: str = ""

    @property
    def certain(self) -> bool:
        """Whether all rows that the file counts can be read: the machine has not been off since."""
        if not self.commits:
            return True
        return self.rows == self.commits[0].rows and self.boot == boot_id() != ""


def count_intact(path: Path, found: Inspection) -> int:
    """Return how many rows of an unsealed partition file really are what was written.

    Args:
        path: The file.
        found: What it says of itself.
    """
    row_nbytes = found.identity.field.nbytes
    if not found.commits:
        return found.rows
    with open_partition(path) as file:
        try:
            intact = find_intact(file.fileno(), found.data_offset, row_nbytes, found.commits)
        except OSError as error:
            raise cannot_read(path, error) from error
    if intact is None or intact.rows > found.capacity:
        raise DatasetError(
            f"{path} was changed or is damaged: its rows have other checksums than its records. "
            "Restore it from a copy, or set it aside with `physx verify --repair`."
        )
    return intact.rows


def partition_file(session: str, mode: str, field: str, index: int) -> str:
    """Return the name of a partition file."""
    return f"{session}_{mode}_{field}_{index}.h5"


def make_header(identity: Identity, capacity: int, rows: int = 0) -> Header:
    """Have h5py make the header of a partition file.

    Args:
        identity: What the file is part of.
        capacity: How many rows fit in.
        rows: Number of committed rows that the header states.
    """
    import h5py
    from h5py import h5d, h5p, h5s, h5t

    field = identity.field
    layout = h5p.create(h5p.DATASET_CREATE)
    layout.set_layout(h5d.CONTIGUOUS)
    layout.set_alloc_time(h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5d.FILL_TIME_NEVER)
    kind = h5t.py_create(np.dtype(field.dtype), logical=True)
    image = io.BytesIO()
    with h5py.File(
        image, "w", libver=("earliest", "v110"), alignment_threshold=2048, alignment_interval=_PAGE
    ) as file:
        for name, value in (identity.attributes | {"boot": boot_id()}).items():
            file.attrs[name] = value
        scalar, table = h5s.create(h5s.SCALAR), h5s.create_simple((RECORDS, len(Commit._fields)))
        counter = h5d.create(file.id, b"rows", h5t.STD_U64LE, scalar, layout)
        counter.write(h5s.ALL, h5s.ALL, np.array(rows, "<u8"))
        records = h5d.create(file.id, b"commits", h5t.STD_U64LE, table, layout)
        records.write(h5s.ALL, h5s.ALL, np.array([Commit.unchecked(rows)] * RECORDS, "<u8"))
        space = h5s.create_simple((capacity, *(field.shape or ())))
        data = h5d.create(file.id, b"data", kind, space, layout)
        rows_offset, data_offset = counter.get_offset(), data.get_offset() or 0
        if (
            records.get_offset() != rows_offset + COUNT.size
            or rows_offset // SECTOR != (rows_offset + NBYTES - 1) // SECTOR
        ):
            raise RuntimeError("HDF5 has put the row count and the records into different sectors.")
    content = image.getvalue()
    size = max(len(content), data_offset + capacity * field.nbytes)
    return Header(content, rows_offset, data_offset, size)


def inspect(path: Path, offset: int | None = None, row_nbytes: int = 0) -> Inspection:
    """Read what a partition file says of itself.

    Args:
        path: The file.
        offset: Where its rows begin, if that is known; only for error messages.
        row_nbytes: Bytes of one row, likewise.
    """
    with open_partition(path) as file:
        return inspect_open(file, path, offset, row_nbytes)


def open_partition(path: Path) -> io.FileIO:
    """Open a partition file for reading."""
    try:
        return io.FileIO(str(path), opener=files.open_regular)
    except FileNotFoundError:
        raise DatasetError(
            f"The partition {path.name} is missing from {path.parent}. Restore it: without it, "
            "the rows of this partition cannot be read in any field."
        ) from None
    except OSError as error:
        raise cannot_read(path, error) from error


def cannot_read(path: Path, error: OSError) -> DatasetError:
    """Return the error for a partition file that the system cannot open, map or read."""
    full = error.errno in (errno.EMFILE, errno.ENFILE)
    advice = " Raise the limit of open files (ulimit -n)." if full else ""
    return DatasetError(f"The partition {path} cannot be read: {error.strerror}.{advice}")


def inspect_open(
    file: io.FileIO, path: Path, offset: int | None = None, row_nbytes: int = 0
) -> Inspection:
    """Return the header of an open partition file, as `inspect` does."""
    import h5py

    _check_superblock(file, path, offset, row_nbytes)
    try:
        with h5py.File(file, "r") as content:
            found = _inspection(content)
    except (*UNREADABLE, PhysxError) as error:
        raise DatasetError(f"{path} is damaged or not a dataset's partition: {error}.") from error
    size, field = os.fstat(file.fileno()).st_size, found.identity.field
    expected = found.data_offset + found.capacity * field.nbytes
    if size < expected:
        raise truncated(path, size, expected, found.data_offset, field.nbytes)
    return found


def truncated(path: Path, actual: int, expected: int, offset: int, row_nbytes: int) -> DatasetError:
    """Return the error for a partition file that is shorter than its rows."""
    kept = max(0, actual - offset) // row_nbytes if row_nbytes else 0
    return DatasetError(
        f"The partition {path} is truncated: it has {actual} bytes, {expected} were expected. "
        f"{kept} rows of this file are still there. Restore the whole file from a copy."
    )


def _check_superblock(file: io.FileIO, path: Path, offset: int | None, row_nbytes: int) -> None:
    head = os.pread(file.fileno(), 48, 0)
    if not head.startswith(SIGNATURE):
        raise DatasetError(f"{path} is damaged or not a dataset's partition: it is not HDF5.")
    actual = os.fstat(file.fileno()).st_size
    expected = int.from_bytes(head[_END_OF_FILE : _END_OF_FILE + 8], "little")
    if head[8] == 0 and actual < expected:
        raise truncated(path, actual, expected, _PAGE if offset is None else offset, row_nbytes)


def _inspection(content: Any) -> Inspection:
    attributes = content.attrs
    if attributes["format"] != FORMAT:
        raise ValueError(f"its format is {attributes['format']!r}, not {FORMAT!r}")
    version = int(attributes["format_version"])
    if version not in READABLE:
        raise ValueError(f"its format has version {version}; this physx reads {list(READABLE)}")
    data, counter = _plain_dataset(content, "data"), _plain_dataset(content, "rows")
    if counter.shape != () or counter.dtype != np.dtype("<u8") or not data.shape:
        raise ValueError("its datasets do not have the shapes or types of a partition's")
    field = Field(
        str(attributes["field"]),
        data.shape[1:],
        data.dtype,
        str(attributes["unit"]),
        str(attributes["role"]),  # type: ignore[arg-type]
    )
    if np.dtype(field.dtype) != data.dtype or field.role not in ("training", "additional"):
        raise ValueError(f"{data.dtype} and {field.role!r} are not the type and role of a field")
    data_offset = data.id.get_offset()
    if counter.id.get_offset() is None or (data_offset is None and data.size * field.nbytes):
        raise ValueError("it has no space allocated for rows")
    identity = Identity(
        str(attributes["session"]),
        str(attributes["mode"]),
        field,
        int(attributes["partition"]),
        int(attributes["first_row"]),
    )
    return Inspection(
        identity,
        capacity=data.shape[0],
        rows=min(int(counter[()]), data.shape[0]),
        data_offset=data_offset or 0,
        commits=_commits(content) if version > 1 else (),
        boot=str(attributes["boot"]) if version > 1 else "",
    )


def _commits(content: Any) -> tuple[Commit, ...]:
    records = _plain_dataset(content, "commits")
    if records.shape != (RECORDS, len(Commit._fields)) or records.dtype != np.dtype("<u8"):
        raise ValueError("its records do not have the shape or type of a partition's")
    return tuple(Commit(*record) for record in records[()].tolist())


def _plain_dataset(content: Any, name: str) -> Any:
    """Return a dataset whose bytes are contiguous in this very file."""
    import h5py

    if not isinstance(content.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name!r} is a link")
    dataset = content[name]
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{name!r} is not an array")
    layout = dataset.id.get_create_plist()
    if layout.get_layout() != h5py.h5d.CONTIGUOUS or layout.get_external_count():
        raise ValueError(f"{name!r} is not stored contiguously in this file")
    return dataset
