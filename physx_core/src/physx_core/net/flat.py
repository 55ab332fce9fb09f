"""Flat dictionaries: names to arrays, whose layout as bytes is worked out only once.

A sample or prediction has the same names, types and shapes again and again. So the JSON text in
front of its raw bytes, and where each array lies in them, are kept and found again. The bytes say
everything: neither side needs to have seen any before.
"""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import Any, TypeAlias

import numpy as np

from physx_core.typing import Array

LENGTH = struct.Struct("<I")
"""Length of the JSON text that follows."""

OPENING = b'{"flat":'
"""Begin of the JSON text of a flat dictionary."""

LONGEST_TEXT = 4096
"""Longest JSON text in bytes that a flat dictionary has."""

_MOST_KEPT = 256
_ALIGNMENT = 16
_NUMBERS = "biufc"
_DTYPE = re.compile(r"[<>|]([biufcSU]\d{1,9}|[mM]8(\[[0-9a-zA-Z]{1,20}\])?)")
_SCALAR = "scalar"
_LAST_CHARACTER = 0x10FFFF

_layout_of = attrgetter("__class__", "dtype", "shape")
_Layout: TypeAlias = tuple[type[Any], np.dtype[Any], tuple[int, ...]]
_Place: TypeAlias = tuple[str, np.dtype[Any], tuple[int, ...], int]
_Finish: TypeAlias = tuple[str, Callable[[Array], Any]]


def flat_prefix(value: dict[Any, Any]) -> tuple[bytes, int]:
    """Return what stands in front of a dictionary's arrays, and how long it is with them.

    Args:
        value: Flat if all keys are ASCII texts, and all values arrays of numbers or NumPy's
            numbers; otherwise the prefix is empty.
    """
    try:
        return _prefix((*value, *map(type, value)), tuple(map(_layout_of, value.values())))
    except AttributeError:
        return b"", 0


def flat_bytes(prefix: bytes, value: dict[str, Any]) -> bytes:
    """Return a flat dictionary as bytes behind its prefix."""
    try:
        return b"".join((prefix, *value.values()))
    except TypeError:  # an array is not contiguous
        arrays = [np.ascontiguousarray(array).data for array in value.values()]
        return b"".join((prefix, *arrays))


@lru_cache(_MOST_KEPT)
def _prefix(keys: tuple[Any, ...], layouts: tuple[_Layout, ...]) -> tuple[bytes, int]:
    """Return the text with its length in front, and the length of all bytes; no text: not flat.

    Args:
        keys: The keys, and then their types.
        layouts: Type, and type and shape of the elements, of each value.
    """
    entries: list[list[Any]] = []
    length = 0
    for name, key, (kind, dtype, shape) in zip(keys, keys[len(layouts) :], layouts, strict=False):
        is_array = kind is np.ndarray
        if key is not str or not name.isascii() or not (is_array or issubclass(kind, np.generic)):
            return b"", 0
        if dtype.kind not in _NUMBERS:
            return b"", 0
        entries.append([name, dtype.str, shape if is_array else _SCALAR])
        length += math.prod(shape) * dtype.itemsize
    text = OPENING + json.dumps(entries, separators=(",", ":")).encode() + b"}"
    text += b" " * (-(LENGTH.size + len(text)) % _ALIGNMENT)
    if len(text) > LONGEST_TEXT:
        return b"", 0
    prefix = LENGTH.pack(len(text)) + text
    return prefix, len(prefix) + length


def flat_value(text: bytes, payload: bytearray) -> dict[str, Any]:
    """Return the dictionary that `flat_bytes` was given.

    Args:
        text: The JSON text, not longer than `LONGEST_TEXT`.
        payload: All bytes, those of the text among them; the arrays are views of them.

    Raises:
        ValueError: Text or bytes are damaged; or another exception of damaged JSON.
    """
    places, finishes, length = _places(text)
    if len(payload) != length:
        raise ValueError(f"there are {len(payload)} bytes instead of {length}")
    value = {
        name: np.ndarray(shape, dtype, payload, offset) for name, dtype, shape, offset in places
    }
    for name, finish in finishes:
        value[name] = finish(value[name])
    return value


@lru_cache(_MOST_KEPT)
def _places(text: bytes) -> tuple[list[_Place], list[_Finish], int]:
    """Return where the arrays lie, what remains to be done with some, and the length of all."""
    offset = LENGTH.size + len(text)
    places: list[_Place] = []
    finishes: list[_Finish] = []
    for name, kind, sizes in json.loads(text)["flat"]:
        dtype = plain_dtype(kind)
        shape = () if sizes == _SCALAR else plain_shape(sizes)
        if not isinstance(name, str) or dtype.kind not in _NUMBERS:
            raise ValueError(f"an entry is damaged: {str(name)[:50]!r}")
        if dtype.kind == "b":
            finishes.append((name, checked))
        if sizes == _SCALAR:
            finishes.append((name, _scalar))
        elif offset % dtype.alignment:
            finishes.append((name, np.ndarray.copy))
        places.append((name, dtype, shape, offset))
        offset += math.prod(shape) * dtype.itemsize
    return places, finishes, offset


def _scalar(array: Array) -> Any:
    return array[()]


def checked(array: Array) -> Array:
    """Return an array that was received.

    Raises:
        ValueError: Its bytes stand for no truth values or no characters.
    """
    kind, order = array.dtype.kind, array.dtype.byteorder
    if kind == "b" and (array.view(np.uint8) > 1).any():
        raise ValueError("truth values are neither 0 nor 1")
    if kind == "U" and array.size and array.dtype.itemsize:
        codes = array.reshape(-1).view(np.dtype(np.uint32).newbyteorder(order))
        if (codes > _LAST_CHARACTER).any():
            raise ValueError("characters are none")
    return array


def plain_dtype(text: Any) -> np.dtype[Any]:
    """Return the NumPy type of a text that was received.

    Raises:
        ValueError: It is none whose elements have a fixed plain layout.
        TypeError: The same.
    """
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"{str(text)[:50]!r} is no plain type")
    return np.dtype(text)


def plain_shape(sizes: Any) -> tuple[int, ...]:
    """Return the shape of a list that was received.

    Raises:
        ValueError: It is none.
    """
    if not isinstance(sizes, list) or not all(type(n) is int and 0 <= n < 1 << 60 for n in sizes):
        raise ValueError(f"{str(sizes)[:50]!r} is no shape")
    return tuple(sizes)
