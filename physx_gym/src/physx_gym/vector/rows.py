"""Layout of the rows that a client of a parallel vector environment sends after each step."""

from __future__ import annotations

import enum
from typing import Any

import numpy as np

from physx_core import Field
from physx_core.net import decode
from physx_core.typing import Array
from physx_gym.spaces import SpaceFields

ROW = "row"
"""Name of the field that holds the records."""
LENGTH = 8
"""Bytes of the length in front of a packed value."""
_INFO_BYTES = 512


class InfoKind(enum.IntEnum):
    """The form in which a record holds an info."""

    NONE = 0
    """There is no info."""
    NUMBERS = 1
    """A record of the layout that the client announced last."""
    PACKED = 2
    """A packed value; if that is empty, the client sent the info before the row."""


class RowLayout:
    """Layout of a row, which has a record for each of a client's environments.

    Attributes:
        dtype: Type of a record: the fields of the observation; ``reward``, ``terminated``,
            ``truncated``; if they are sent, the fields of the last observation of a finished
            episode, prefixed with ``final_``; ``info``: an `InfoKind`; ``infos``: the info's bytes.
        field: The row as a field of bytes.
    """

    def __init__(self, observations: SpaceFields, share: int, *, has_finals: bool) -> None:
        """Compute the layout.

        Args:
            observations: Fields of an observation.
            share: Number of environments of a client.
            has_finals: Whether last observations are sent.
        """
        entries = [(field.name, field.dtype, field.shape or ()) for field in observations.fields]
        finals = [(f"final_{name}", *rest) for name, *rest in entries if has_finals]
        flags = [("terminated", "bool"), ("truncated", "bool")]
        info = [("info", "uint8"), ("infos", "uint8", (_INFO_BYTES,))]
        each: list[Any] = [*entries, ("reward", "float64"), *flags, *finals, *info]
        self.dtype = np.dtype(each, align=True)
        self.field = Field(ROW, (share * self.dtype.itemsize,), "uint8")

    def records(self, rows: Array) -> Array:
        """Return the records of rows, shape (rows, bytes), as one array, shape (records,)."""
        return rows.reshape(-1).view(self.dtype)


def put_packed(target: Array, encoded: bytes) -> None:
    """Write an encoded value, preceded by its length, to the start of an array of bytes."""
    whole = len(encoded).to_bytes(LENGTH, "little") + encoded
    target[: len(whole)] = np.frombuffer(whole, np.uint8)


def unpack(data: Array) -> Any:
    """Return the value that `put_packed` wrote; None if it is empty."""
    length = int.from_bytes(data[:LENGTH].tobytes(), "little")
    return decode(data[LENGTH : LENGTH + length].tobytes()) if length else None
