"""Messages between an environment and its program: a header, descriptions of arrays, their data.

The other side is ``include/physx.h``, which describes every array that it sends and every array
that it requests. An answer contains only the data of the requested arrays, so a program parses
nothing but headers.
"""

from __future__ import annotations

import enum
import functools
import math
import struct
from typing import Any, NamedTuple

import numpy as np

from physx_core.fields import RESERVED, Field
from physx_core.typing import Array, Sample

HEADER = struct.Struct("<4sHHQ")
"""Magic number, kind, number of described arrays, bytes of data after the descriptions."""
DESCRIPTION = struct.Struct("<52sIiI8q")
"""Name, type, rank (-1: the shape is open), whether it is requested rather than sent, shape."""

_MAGIC, _VERSION = b"phy", 1
_MOST_ARRAYS = 64
_MOST_AXES = 8
_OPEN = -1
_LARGEST = 1 << 30  # bytes of a message, as between client and server
_TYPES = {
    ord(name[0]) * 256 + int(name[1:]): np.dtype(f"<{name}")
    for name in ["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8", "c8", "c16"]
}
"""Type number to type; "b1" is a boolean."""


class Kind(enum.IntEnum):
    """Kind of a message."""

    FIELDS = 1
    """Program, once at startup: the fields of a sample."""
    PARAMETERS = 2
    """Program: request for parameters."""
    SAMPLE = 3
    """Program: a sample."""
    PREDICT = 4
    """Program: request for a prediction."""
    CLOSE = 5
    """Program: there are no more samples."""
    ANSWER = 6
    """Environment: the data of the requested arrays."""
    PART = 7
    """Program, before the fields: they are this rank's parts of the fields. Its array ``part`` has
    the rank, the number of ranks, and the offset of each field's part along the first axis."""


_OF_PROGRAMS = frozenset(Kind) - {Kind.ANSWER}


class MalformedMessageError(Exception):
    """A program's message violates the protocol; the text completes ``The program ...``."""


class Header(NamedTuple):
    """The header of a message.

    Attributes:
        kind: Kind of the message.
        arrays: Number of arrays that it describes.
        size: Bytes of the data after the descriptions.
    """

    kind: Kind
    arrays: int
    size: int


class Message(NamedTuple):
    """A program's message.

    Attributes:
        kind: Its kind.
        given: The arrays that it contains, by name.
        wanted: The arrays that it requests.
    """

    kind: Kind
    given: Sample
    wanted: tuple[Field, ...]


def parse_header(data: bytes | bytearray) -> Header:
    """Check a header and return its parts.

    Raises:
        MalformedMessageError: If it does not belong to a message that a program may send.
    """
    magic, kind, count, size = HEADER.unpack(data)
    if magic[:3] != _MAGIC:
        raise MalformedMessageError(f"sent {magic.hex(' ')}... where a message should start.")
    if magic[3] != _VERSION:
        raise MalformedMessageError(
            f"was compiled with a physx.h of protocol {magic[3]}, but this physx uses {_VERSION}: "
            "compile it with the header in the folder that  physx include  prints."
        )
    if kind not in _OF_PROGRAMS or count > _MOST_ARRAYS or size > _LARGEST:
        raise MalformedMessageError(
            f"sent a message of kind {kind} with {count} arrays of {size} bytes, which physx.h "
            f"never sends, or which is longer than {_LARGEST} bytes."
        )
    return Header(Kind(kind), count, size)


@functools.lru_cache(maxsize=16)  # the same for all samples of a program
def parse_descriptions(header: Header, data: bytes) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
    """Return the arrays whose data follows, and those that are requested.

    Raises:
        MalformedMessageError: If a description is malformed, or the size of the data differs from
            the header.
    """
    given: list[Field] = []
    wanted: list[Field] = []
    for parts in DESCRIPTION.iter_unpack(data):
        (wanted if parts[3] else given).append(_parse_description(parts, header.kind))
    for group in (given, wanted):
        names = [field.name for field in group]
        if len(set(names)) < len(names):
            raise MalformedMessageError(
                f"gave two arrays in one message the same name: {sorted(names)}."
            )
    size = sum(field.nbytes for field in given)
    if size != header.size or sum(field.nbytes for field in wanted) > _LARGEST:
        raise MalformedMessageError(
            f"described arrays of {size} bytes, but announced {header.size}, or wants more than "
            f"{_LARGEST}."
        )
    return tuple(given), tuple(wanted)


def _parse_description(parts: tuple[Any, ...], kind: Kind) -> Field:
    raw, number, rank, _, *shape = parts
    name = raw.partition(b"\0")[0].decode("ascii", errors="replace")
    if not name.isidentifier() or (name in RESERVED and kind is not Kind.PARAMETERS):
        raise MalformedMessageError(
            f"named an array {name!r}, which is not an identifier, or is reserved by physx."
        )
    if number not in _TYPES:
        raise MalformedMessageError(f'gave the array "{name}" the unknown type {number}.')
    if not (0 <= rank <= _MOST_AXES or (rank == _OPEN and kind is Kind.FIELDS)):
        raise MalformedMessageError(f'gave the array "{name}" the rank {rank}.')
    axes = None if rank == _OPEN else tuple(shape[:rank])
    dtype = _TYPES[number]
    if axes and not (min(axes) >= 0 and math.prod(axes) * dtype.itemsize <= _LARGEST):
        raise MalformedMessageError(f'gave the array "{name}" the shape {axes}.')
    return Field(name, axes, dtype)


def check_values(field: Field, values: Array) -> None:
    """Check that the bytes of booleans are zeros and ones, which nothing else checks.

    Raises:
        MalformedMessageError: If they are not.
    """
    if values.dtype.kind == "b" and values.tobytes().translate(None, b"\0\1"):
        raise MalformedMessageError(f'sent "{field.name}", which is neither true nor false.')


def pack_answer(values: list[Array]) -> list[bytes | memoryview]:
    """Return the parts of an answer: a header, and the data of each requested array."""
    size = sum(array.nbytes for array in values)
    header = HEADER.pack(_MAGIC + bytes([_VERSION]), Kind.ANSWER, len(values), size)
    return [header, *(np.ascontiguousarray(array).data for array in values if array.size)]
