"""What a client of a parallel vector environment sends after each step: one record of bytes."""

from __future__ import annotations

from typing import Any

import numpy as np

from physx_core.fields import Array, Field
from physx_core.gym.space_fields import SpaceFields
from physx_core.transport.values import decode

ROW = "row"
"""Name of the field that holds the record."""
LENGTH = 8
"""Bytes of the length in front of a text."""
_INFO_BYTES = 512


class RowLayout:
    """Where everything lies in a row; each entry has a leading axis of the client's environments.

    Attributes:
        dtype: The row as a record: the observation's fields; ``reward``, ``terminated`` and
            ``truncated``; in front of each field of the observation ``final_`` for that of an
            episode that is over; ``has_numbers``: whether infos are records of the layout that was
            told last; ``infos``: those, or a text after its length, which is 0 for none.
        field: The row as a field of bytes.
    """

    def __init__(self, observations: SpaceFields, share: int, *, has_finals: bool) -> None:
        """Work it out.

        Args:
            observations: Fields of an observation.
            share: How many environments a client has.
            has_finals: Whether rows hold the last observations of episodes that are over.
        """
        entries = [(f.name, f.dtype, (share, *(f.shape or ()))) for f in observations.fields]
        finals = [(f"final_{name}", *rest) for name, *rest in entries if has_finals]
        each: list[Any] = [
            *entries,
            ("reward", "float64", (share,)),
            ("terminated", "bool", (share,)),
            ("truncated", "bool", (share,)),
            *finals,
            ("has_numbers", "bool"),
            ("infos", "uint8", (LENGTH + share * _INFO_BYTES,)),
        ]
        self.dtype = np.dtype(each, align=True)
        self.field = Field(ROW, (self.dtype.itemsize,), "uint8")

    def records(self, rows: Array) -> Array:
        """Return rows of bytes, shape (clients, bytes), as records, shape (clients,)."""
        return rows.view(self.dtype)[:, 0]


def put_text(target: Array, text: bytes) -> None:
    """Write a text to the begin of an array of bytes, after its length."""
    whole = len(text).to_bytes(LENGTH, "little") + text
    target[: len(whole)] = np.frombuffer(whole, np.uint8)


def text_value(data: Array) -> Any:
    """Return the value of a text that `put_text` wrote; None: there is none."""
    length = int.from_bytes(data[:LENGTH].tobytes(), "little")
    return decode(data[LENGTH : LENGTH + length].tobytes()) if length else None
