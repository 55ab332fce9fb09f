"""Reads headers of partition files of version 1, which are readable only through HDF5.

These files have no records: for an open one, only the row count is known.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core import files
from physx_core.fields import Field

UNREADABLE = (
    OSError, RuntimeError, LookupError, TypeError, ValueError, ArithmeticError, AttributeError,
    MemoryError,
)  # fmt: skip
"""Errors that h5py raises for damaged files."""


_HEAP = b"GCOL\1\0\0\0"
_OBJECT = struct.Struct("<HHIQ")  # number, references, reserved, size
_LONGEST = 2**16


@dataclass(frozen=True)
class HeaderV1:
    """Contents of a version 1 header: see `Identity` and `Inspection`."""

    session: str
    mode: str
    field: Field
    index: int
    first_row: int
    capacity: int
    rows: int
    rows_offset: int
    data_offset: int


def read_header(file: io.FileIO) -> HeaderV1:
    """Return the header of a partition file of version 1.

    Raises:
        ValueError: If the file is not such a partition, or is damaged.
    """
    import h5py

    _check_heaps(files.read_head(file.fileno(), _LONGEST))
    try:
        with h5py.File(file, "r") as content:
            return _inspect(content)
    except UNREADABLE as error:
        raise ValueError(str(error)) from error


def _check_heaps(head: bytes) -> None:
    """Check that HDF5 reaches the end of the heaps that hold the strings of attributes.

    It would read an empty object, as left by lost sectors, forever.
    """
    start = head.find(_HEAP)
    while start >= 0:
        place = start + _OBJECT.size
        end = min(start + int.from_bytes(head[start + 8 : place], "little"), len(head))
        while place + _OBJECT.size <= end:
            number, _, _, size = _OBJECT.unpack_from(head, place)
            if number == 0 and size == 0:
                raise ValueError("its header is damaged")
            place += size if number == 0 else _OBJECT.size + size + -size % 8
        start = head.find(_HEAP, start + 1)


def _inspect(content: Any) -> HeaderV1:
    attributes = content.attrs
    if attributes["format"] != "physx partition" or int(attributes["format_version"]) != 1:
        raise ValueError("it has no physx header")
    data, counter = _plain_dataset(content, "data"), _plain_dataset(content, "rows")
    if counter.shape != () or counter.dtype != np.dtype("<u8") or not data.shape:
        raise ValueError("its datasets do not have the shapes or types of a partition")
    field = Field(
        str(attributes["field"]),
        data.shape[1:],
        data.dtype,
        str(attributes["unit"]),
        str(attributes["role"]),  # type: ignore[arg-type]
    )
    if np.dtype(field.dtype) != data.dtype or field.role not in ("training", "additional"):
        raise ValueError(f"{data.dtype} and {field.role!r} are not the type and role of a field")
    counter_offset, data_offset = counter.id.get_offset(), data.id.get_offset()
    if counter_offset is None or (data_offset is None and data.size * field.nbytes):
        raise ValueError("it has no space allocated for rows")
    return HeaderV1(
        session=str(attributes["session"]),
        mode=str(attributes["mode"]),
        field=field,
        index=int(attributes["partition"]),
        first_row=int(attributes["first_row"]),
        capacity=data.shape[0],
        rows=min(int(counter[()]), data.shape[0]),
        rows_offset=counter_offset,
        data_offset=data_offset or 0,
    )


def _plain_dataset(content: Any, name: str) -> Any:
    """Return a dataset after checking that its bytes are contiguous in this file."""
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
