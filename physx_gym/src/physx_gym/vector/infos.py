"""Infos in shared memory: records of numbers of a known layout, or encoded values."""

from __future__ import annotations

import enum
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from physx_core.net import decode
from physx_core.typing import Array

LENGTH = 8
"""Size of the length in front of an encoded value, in bytes."""


class InfoKind(enum.IntEnum):
    """The form of an info; a positive number is the number of its record layout.

    A worker numbers its layouts from 1, and sends each before it uses it.
    """

    NONE = 0
    """There is no info."""
    PACKED = -1
    """An encoded value."""
    SENT = -2
    """The worker sent it as a message: it did not fit, or something in it cannot be sent."""


_CODES: dict[type[Any], str] = {
    **{float: "d", int: "q", bool: "?"},
    **{np.int8: "b", np.int16: "h", np.int32: "i", np.int64: "q"},
    **{np.uint8: "B", np.uint16: "H", np.uint32: "I", np.uint64: "Q"},
    **{np.float16: "e", np.float32: "f", np.float64: "d"},
}
_KINDS = {kind.__name__: kind for kind in _CODES}


def put_packed(target: Array, encoded: bytes) -> bool:
    """Write an encoded value to the start of an array of bytes; return whether it fits."""
    whole = len(encoded).to_bytes(LENGTH, "little") + encoded
    if len(whole) > len(target):
        return False
    target[: len(whole)] = np.frombuffer(whole, np.uint8)
    return True


def unpack(data: Array) -> Any:
    """Return the value that `put_packed` wrote."""
    length = int.from_bytes(data[:LENGTH].tobytes(), "little")
    return decode(data[LENGTH : LENGTH + length].tobytes())


class _Entry(NamedTuple):
    """An entry of an info: a number of some type, or a dictionary with its own entries."""

    name: str
    kind: type[Any]
    inner: list[_Entry]


class InfoLayout:
    """Names and types of infos that hold only numbers and dictionaries of them.

    Attributes:
        names: Pairs of a name and the name of its type, or the pairs of a dictionary.
        dtype: Type of an info as a record; its fields are the numbers, in order.
    """

    def __init__(self, names: Sequence[Any]) -> None:
        """Create the layout of names."""
        self.names = names
        self._entries = _parse(names)
        kinds = [*_kinds(self._entries)]
        self.dtype = np.dtype([(str(place), kind) for place, kind in enumerate(kinds)])
        self._codes = "=" + "".join(_CODES[kind] for kind in kinds)

    @classmethod
    def of(cls, info: Mapping[str, Any]) -> InfoLayout | None:
        """Return the layout of an info; None if it is empty, or holds anything but numbers."""
        try:
            return cls(_describe(info))
        except ValueError:
            return None

    def put(self, info: Mapping[str, Any], target: Array) -> bool:
        """Write an info as a record.

        Args:
            info: A dictionary.
            target: Bytes to write to, from the first one on.

        Returns:
            Whether the info has this layout and fits; otherwise nothing is written.
        """
        values: list[Any] = []
        if not _gather(self._entries, info, values) or self.dtype.itemsize > len(target):
            return False
        try:
            struct.pack_into(self._codes, target.data, 0, *values)
        except struct.error:  # an integer is too large
            return False
        return True

    def records(self, data: Array) -> Array:
        """Return the records at the start of each row of bytes, shape (rows,)."""
        return data[:, : self.dtype.itemsize].copy().view(self.dtype)[:, 0]

    def info(self, data: Array) -> dict[str, Any]:
        """Return the info that was written to the start of an array of bytes."""
        return _info(self._entries, iter(self.records(data[np.newaxis])[0]))

    def columns(self, records: Array, given: Array) -> dict[str, Any]:
        """Return records in the form of the infos of Gymnasium's vector environments.

        Args:
            records: Shape (environments,).
            given: Which of them are valid, shape (environments,); the others become zeros.

        Returns:
            For each name an array of shape (environments,), and, as ``_name``, which environments
            have it.
        """
        if not given.all():
            records[~given] = 0
        return _columns(self._entries, (records[name] for name in self.dtype.names or ()), given)


def _describe(info: Mapping[str, Any]) -> list[Any]:
    return [
        (name, _describe(value) if isinstance(value, dict) else type(value).__name__)
        for name, value in info.items()
    ]


def _parse(names: Sequence[Any]) -> list[_Entry]:
    entries = []
    for name, what in names:
        kind = dict if isinstance(what, (list, tuple)) else _KINDS.get(what)
        if kind is None or name.startswith("_") or name == "final_obs":  # Gymnasium's own
            raise ValueError(f"{name} is not a number")
        entries.append(_Entry(name, kind, _parse(what) if kind is dict else []))
    if not entries:
        raise ValueError("there are no numbers")
    return entries


def _kinds(entries: Sequence[_Entry]) -> Iterator[type[Any]]:
    for _, kind, inner in entries:
        if inner:
            yield from _kinds(inner)
        else:
            yield kind


def _gather(entries: Sequence[_Entry], info: Mapping[str, Any], values: list[Any]) -> bool:
    """Append an info's numbers to a list; return whether it has exactly these entries."""
    if len(info) != len(entries):
        return False
    for name, kind, inner in entries:
        value: Any = info.get(name)
        if type(value) is not kind:
            return False
        if inner:
            if not _gather(inner, value, values):
                return False
        else:
            values.append(value)
    return True


def _info(entries: Sequence[_Entry], values: Iterator[Any]) -> dict[str, Any]:
    return {
        name: _info(inner, values) if inner else kind(next(values)) for name, kind, inner in entries
    }


def _columns(entries: Sequence[_Entry], columns: Iterator[Array], given: Array) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, _, inner in entries:
        found[name] = _columns(inner, columns, given) if inner else next(columns).copy()
        found[f"_{name}"] = given.copy()
    return found
