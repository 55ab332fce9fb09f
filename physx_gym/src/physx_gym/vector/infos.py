"""Infos of several environments as records of numbers, where all have the same names."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from physx_core.typing import Array

_CODES: dict[type[Any], str] = {
    **{float: "d", int: "q", bool: "?"},
    **{np.int8: "b", np.int16: "h", np.int32: "i", np.int64: "q"},
    **{np.uint8: "B", np.uint16: "H", np.uint32: "I", np.uint64: "Q"},
    **{np.float16: "e", np.float32: "f", np.float64: "d"},
}
_KINDS = {kind.__name__: kind for kind in _CODES}


class _Entry(NamedTuple):
    """A name of an info: a number of some type, or a dictionary with entries of its own."""

    name: str
    kind: type[Any]
    below: list[_Entry]


class InfoLayout:
    """Names and types of infos that hold numbers alone, and dictionaries of them.

    Attributes:
        names: Pairs of a name and what it is: a type's name, or the pairs of a dictionary.
        dtype: An info as a record; its fields are the numbers, in their order.
    """

    def __init__(self, names: Sequence[Any]) -> None:
        """Take the names.

        Raises:
            ValueError: They are no names of numbers.
        """
        self.names = names
        self._entries = _entries(names)
        kinds = [*_kinds(self._entries)]
        self.dtype = np.dtype([(str(place), kind) for place, kind in enumerate(kinds)])
        self._codes = "=" + "".join(_CODES[kind] for kind in kinds)

    @classmethod
    def of(cls, info: Mapping[str, Any]) -> InfoLayout | None:
        """Return the layout of an info; None: it holds nothing, or other things than numbers."""
        try:
            return cls(_names(info))
        except ValueError:
            return None

    def put(self, info: Mapping[str, Any], target: Array) -> bool:
        """Write an info as a record.

        Args:
            info: A dictionary.
            target: Bytes to write to, from their begin.

        Returns:
            Whether it is of this layout and there is room; otherwise nothing is written.
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
        """Return the records that begin each row of bytes, shape (rows,)."""
        return data[:, : self.dtype.itemsize].copy().view(self.dtype)[:, 0]

    def info(self, record: Any) -> dict[str, Any]:
        """Return the info that a record was made of."""
        return _info(self._entries, iter(record))

    def columns(self, records: Array, given: Array) -> dict[str, Any]:
        """Return records as Gymnasium's infos of a vector environment.

        Args:
            records: Shape (environments,).
            given: Which of them are given, shape (environments,); the others count as zeros.

        Returns:
            Each name with its array, shape (environments,), and ``_name`` with which environments
            have it.
        """
        if not given.all():
            records[~given] = 0
        return _columns(self._entries, (records[name] for name in self.dtype.names or ()), given)


def _names(info: Mapping[str, Any]) -> list[Any]:
    return [
        (name, _names(value) if isinstance(value, dict) else type(value).__name__)
        for name, value in info.items()
    ]


def _entries(names: Sequence[Any]) -> list[_Entry]:
    entries = []
    for name, what in names:
        kind = dict if isinstance(what, (list, tuple)) else _KINDS.get(what)
        if kind is None or name.startswith("_") or name == "final_obs":  # Gymnasium's own
            raise ValueError(f"{name} is no number")
        entries.append(_Entry(name, kind, _entries(what) if kind is dict else []))
    if not entries:
        raise ValueError("there are no numbers")
    return entries


def _kinds(entries: Sequence[_Entry]) -> Iterator[type[Any]]:
    for _, kind, below in entries:
        if below:
            yield from _kinds(below)
        else:
            yield kind


def _gather(entries: Sequence[_Entry], info: Mapping[str, Any], values: list[Any]) -> bool:
    """Add an info's numbers to a list; return whether it has these entries and no others."""
    if len(info) != len(entries):
        return False
    for name, kind, below in entries:
        value: Any = info.get(name)
        if type(value) is not kind:
            return False
        if below:
            if not _gather(below, value, values):
                return False
        else:
            values.append(value)
    return True


def _info(entries: Sequence[_Entry], values: Iterator[Any]) -> dict[str, Any]:
    return {
        name: _info(below, values) if below else kind(next(values)) for name, kind, below in entries
    }


def _columns(entries: Sequence[_Entry], columns: Iterator[Array], given: Array) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, _, below in entries:
        found[name] = _columns(below, columns, given) if below else next(columns).copy()
        found[f"_{name}"] = given.copy()
    return found
