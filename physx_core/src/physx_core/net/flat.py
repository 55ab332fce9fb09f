"""Flat dictionaries of arrays, encoded with a layout that is computed only once.

Samples and predictions keep the same names, types and shapes. Therefore, the JSON text before the
raw bytes, and the place of each array in them, are cached. Each message is self-contained: neither
side needs to have seen an earlier one.
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
"""Start of the JSON text of a flat dictionary."""

LONGEST_TEXT = 4096
"""Longest JSON text of a flat dictionary in bytes."""

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


def describe_flat(value: dict[Any, Any]) -> tuple[bytes, int]:
    """Return the bytes that precede a dictionary's arrays, and the total length in bytes.

    Args:
        value: Flat if all keys are ASCII strings and all values are arrays of numbers or NumPy
            numbers; otherwise, the prefix is empty.
    """
    try:
        return _prefix((*value, *map(type, value)), tuple(map(_layout_of, value.values())))
    except AttributeError:
        return b"", 0


def pack_flat(prefix: bytes, value: dict[str, Any]) -> bytes:
    """Return the prefix followed by a flat dictionary's bytes."""
    try:
        return b"".join((prefix, *value.values()))
    except TypeError:  # an array is not contiguous
        arrays = [np.ascontiguousarray(array).data for array in value.values()]
        return b"".join((prefix, *arrays))


@lru_cache(_MOST_KEPT)
def _prefix(keys: tuple[Any, ...], layouts: tuple[_Layout, ...]) -> tuple[bytes, int]:
    """Return the length-prefixed JSON text (empty if not flat) and the total length in bytes.

    Args:
        keys: The keys, followed by their types.
        layouts: Class, dtype and shape of each value.
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


def unpack_flat(text: bytes, payload: bytearray) -> dict[str, Any]:
    """Return the dictionary that was given to `pack_flat`.

    Args:
        text: The JSON text, not longer than `LONGEST_TEXT`.
        payload: All bytes, including those of the text; the arrays are views of them.
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
    """Return the places of the arrays, functions to apply to some of them, and the length."""
    offset = LENGTH.size + len(text)
    places: list[_Place] = []
    finishes: list[_Finish] = []
    for name, kind, sizes in json.loads(text)["flat"]:
        dtype = parse_dtype(kind)
        shape = () if sizes == _SCALAR else parse_shape(sizes)
        if not isinstance(name, str) or dtype.kind not in _NUMBERS:
            raise ValueError(f"an entry is damaged: {str(name)[:50]!r}")
        if dtype.kind == "b":
            finishes.append((name, check_array))
        if sizes == _SCALAR:
            finishes.append((name, _scalar))
        elif offset % dtype.alignment:
            finishes.append((name, np.ndarray.copy))
        places.append((name, dtype, shape, offset))
        offset += math.prod(shape) * dtype.itemsize
    return places, finishes, offset


def _scalar(array: Array) -> Any:
    return array[()]


def check_array(array: Array) -> Array:
    """Return a received array after checking its bytes."""
    kind, order = array.dtype.kind, array.dtype.byteorder
    if kind == "b" and (array.view(np.uint8) > 1).any():
        raise ValueError("some booleans are neither 0 nor 1")
    if kind == "U" and array.size and array.dtype.itemsize:
        codes = array.reshape(-1).view(np.dtype(np.uint32).newbyteorder(order))
        if (codes > _LAST_CHARACTER).any():
            raise ValueError("there are invalid characters")
    return array


def parse_dtype(text: Any) -> np.dtype[Any]:
    """Return the NumPy type named by a received string."""
    if not isinstance(text, str) or not _DTYPE.fullmatch(text):
        raise ValueError(f"{str(text)[:50]!r} is not a plain type")
    return np.dtype(text)


def parse_shape(sizes: Any) -> tuple[int, ...]:
    """Return the shape given by a received list."""
    if not isinstance(sizes, list) or not all(type(n) is int and 0 <= n < 1 << 60 for n in sizes):
        raise ValueError(f"{str(sizes)[:50]!r} is not a shape")
    return tuple(sizes)
