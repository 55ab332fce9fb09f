"""What a client of a parallel vector environment sends after each step: records of bytes."""

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
"""Bytes of the length in front of a text."""
_INFO_BYTES = 512


class Info(enum.IntEnum):
    """How a record holds an info."""

    NONE = 0
    """There is none."""
    NUMBERS = 1
    """As a record of the layout that the client told last."""
    TEXT = 2
    """As a text, or not at all if that is empty: then it came before the row."""


class RowLayout:
    """Where everything lies in a row, which has a record for each of a client's environments.

    Attributes:
        dtype: A record: the fields of the observation; ``reward``, ``terminated``, ``truncated``;
            the fields of the last observation of an episode that is over, where such are sent, with
            ``final_`` in front; ``info``: an `Info`; ``infos``: the bytes of the info.
        field: The row as a field of bytes.
    """

    def __init__(self, observations: SpaceFields, share: int, *, has_finals: bool) -> None:
        """Work it out.

        Args:
            observations: Fields of an observation.
            share: How many environments a client has.
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
        """Return the records of rows, shape (rows, bytes), one behind the other."""
        return rows.reshape(-1).view(self.dtype)


def put_text(target: Array, text: bytes) -> None:
    """Write a text to the begin of an array of bytes, after its length."""
    whole = len(text).to_bytes(LENGTH, "little") + text
    target[: len(whole)] = np.frombuffer(whole, np.uint8)


def text_value(data: Array) -> Any:
    """Return the value of a text that `put_text` wrote; None: it is empty."""
    length = int.from_bytes(data[:LENGTH].tobytes(), "little")
    return decode(data[LENGTH : LENGTH + length].tobytes()) if length else None
