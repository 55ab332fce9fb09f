"""Values: converts plain Python and NumPy values to bytes and back, preserving types and bits.

The bytes are a JSON text followed by the raw bytes of arrays. In the JSON text, None, booleans,
strings, lists, finite floats and integers below 2**63 are written as they are; everything else is
an object with one key, its tag. Flat dictionaries have a faster path: see `flat`. Decoding never
runs code from the data.
"""

from __future__ import annotations

import json
import math
import reprlib
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.errors import ConnectionRefusedByPeerError, UsageError
from physx_core.net.flat import (
    LENGTH,
    LONGEST_TEXT,
    OPENING,
    check_array,
    describe_flat,
    pack_flat,
    parse_dtype,
    parse_shape,
    unpack_flat,
)
from physx_core.net.frames import Kind, pack, pack_header
from physx_core.typing import Array

_JSON = json.JSONEncoder(separators=(",", ":"), allow_nan=False)
_PLAIN_KINDS = "biufcSUmM"
_SMALL = 1 << 63
_MAX_TEXT = 1 << 26


def encode(value: Any, what: str = "value") -> bytes:
    """Return a value as bytes.

    Args:
        value: None, bool, int, float, complex, str, bytes, path, NumPy array or number of a plain
            type, or lists, tuples and dictionaries of those.
        what: Name of the value for error messages.

    Raises:
        UsageError: If any part has another type (the message says where), or there is too much
            text.
    """
    if type(value) is dict:
        prefix, _ = describe_flat(value)
        if prefix:
            return pack_flat(prefix, value)
    return _tree_bytes(value, what)


def pack_value(kind: Kind, value: Any, what: str, number: int = 0) -> bytes:
    """Return the bytes of a message whose payload is a value.

    Args:
        kind: Kind of the message.
        value: See `encode`.
        what: Name of the value for error messages.
        number: A number whose meaning depends on the kind.

    Raises:
        UsageError: See `encode`; or if the message is too long.
    """
    if type(value) is dict:
        prefix, length = describe_flat(value)
        if prefix:
            return pack_flat(pack_header(kind, length, number) + prefix, value)
    return pack(kind, _tree_bytes(value, what), number)


def _tree_bytes(value: Any, what: str) -> bytes:
    """Return a value that is not flat as bytes."""
    blobs: list[bytes] = []
    try:
        text = _JSON.encode(_tree(value, what, blobs)).encode("ascii")
    except RecursionError:
        raise UsageError(f"{what} is nested too deeply to be sent to another process.") from None
    if len(text) > _MAX_TEXT:
        raise UsageError(
            f"{what} holds so many separate values that they take {len(text)} bytes of text, but "
            f"at most {_MAX_TEXT} can be sent. Pass NumPy arrays instead of long lists."
        )
    return b"".join([LENGTH.pack(len(text)), text, *blobs])


def decode(payload: bytes | bytearray | memoryview) -> Any:
    """Return the value that was given to `encode`; arrays are new and writable.

    Args:
        payload: The bytes; arrays may be views of it if it is a bytearray.

    Raises:
        ConnectionRefusedByPeerError: If the bytes are not an encoded value.
    """
    try:
        (length,) = LENGTH.unpack_from(payload)
        if length > _MAX_TEXT:
            raise ValueError(f"it has {length} bytes of text")
        start = LENGTH.size + length
        text = bytes(payload[LENGTH.size : start])
        if length <= LONGEST_TEXT and text.startswith(OPENING):
            own = payload if isinstance(payload, bytearray) else bytearray(payload)
            return unpack_flat(text, own)
        return _value(json.loads(text), _Blobs(payload, start))
    except _DAMAGE as error:
        raise ConnectionRefusedByPeerError(
            f"Encoded values that were received or stored are damaged: {str(error)[:200]}."
        ) from error


def _tree(value: Any, where: str, blobs: list[bytes]) -> Any:
    """Return the JSON form of a value; raw bytes are appended to `blobs`."""
    convert = _ENCODERS.get(type(value))
    if convert is not None:
        return convert(value, where, blobs)
    if isinstance(value, np.generic):
        return {"s": _array_parts(np.asarray(value), where, blobs)}
    if isinstance(value, Path):
        return {"p": str(value)}
    raise UsageError(
        f"{where} is {reprlib.repr(value)} ({type(value).__name__}), which cannot be sent to "
        "another process. Use numbers, strings, bytes, paths, NumPy arrays, and lists, tuples and "
        "dictionaries of those; or run with as_tcp_ip_client=False."
    )


def _itself(value: Any, where: str, blobs: list[bytes]) -> Any:
    return value


def _str_tree(value: str, where: str, blobs: list[bytes]) -> Any:
    try:
        value.encode()
    except UnicodeEncodeError:  # lone surrogates; JSON would treat two of them as a pair
        return {"w": _blob(value.encode("utf-8", "surrogatepass"), blobs)}
    return value


def _int_tree(value: int, where: str, blobs: list[bytes]) -> Any:
    return value if -_SMALL <= value < _SMALL else {"i": hex(value)}


def _float_tree(value: float, where: str, blobs: list[bytes]) -> Any:
    return value if math.isfinite(value) else {"f": _bits(value)}


def _items(value: Any, where: str, blobs: list[bytes]) -> list[Any]:
    return [_tree(item, f"{where}[{i}]", blobs) for i, item in enumerate(value)]


def _dict_tree(value: dict[Any, Any], where: str, blobs: list[bytes]) -> Any:
    return {
        "d": [
            [_tree(key, f"a key of {where}", blobs), _tree(item, f"{where}[{key!r}]", blobs)]
            for key, item in value.items()
        ]
    }


def _array_parts(value: Array, where: str, blobs: list[bytes]) -> list[Any]:
    if value.dtype.kind not in _PLAIN_KINDS:
        raise UsageError(
            f"{where} is an array of {value.dtype}, which cannot be sent to another process: "
            "its elements have no fixed plain layout."
        )
    return [value.dtype.str, list(value.shape), _blob(value.tobytes(), blobs)]


def _blob(data: bytes, blobs: list[bytes]) -> int:
    blobs.append(data)
    return len(data)


_ENCODERS: dict[type[Any], Callable[[Any, str, list[bytes]], Any]] = {
    type(None): _itself,
    bool: _itself,
    str: _str_tree,
    int: _int_tree,
    float: _float_tree,
    complex: lambda value, where, blobs: {"c": [_bits(value.real), _bits(value.imag)]},
    bytes: lambda value, where, blobs: {"b": _blob(value, blobs)},
    list: _items,
    tuple: lambda value, where, blobs: {"t": _items(value, where, blobs)},
    dict: _dict_tree,
    np.ndarray: lambda value, where, blobs: {"a": _array_parts(value, where, blobs)},
    np.str_: lambda value, where, blobs: {"u": _str_tree(str.__str__(value), where, blobs)},
    np.bytes_: lambda value, where, blobs: {"y": _blob(bytes(value), blobs)},
}


class _Blobs:
    """The raw bytes after the JSON text, in order."""

    def __init__(self, payload: bytes | bytearray | memoryview, start: int) -> None:
        self._view = memoryview(payload)
        self._start = start

    def take(self, length: Any) -> memoryview:
        if type(length) is not int:
            raise ValueError(f"{str(length)[:50]!r} is not a length")
        end = self._start + length
        if not self._start <= end <= len(self._view):
            raise ValueError("there are fewer raw bytes than announced")
        taken, self._start = self._view[self._start : end], end
        return taken


_DAMAGE = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError),
    *(struct.error, RecursionError, MemoryError),
)


def _value(tree: Any, blobs: _Blobs) -> Any:
    """Return the value of a JSON form."""
    if isinstance(tree, list):
        return [_value(item, blobs) for item in tree]
    if isinstance(tree, dict):
        ((tag, content),) = tree.items()
        return _DECODERS[tag](content, blobs)
    return tree


def _array_of(content: Any, blobs: _Blobs) -> Array:
    kind, sizes, length = content
    dtype, shape = parse_dtype(kind), parse_shape(sizes)
    data = blobs.take(length)
    if math.prod(shape) * max(1, dtype.itemsize) != length:
        raise ValueError(f"{length} bytes are not an array of {kind} and shape {shape}")
    array = np.empty(shape, dtype)
    if length:
        array.reshape(-1).view(np.uint8)[:] = data
    return check_array(array)


_DECODERS: dict[str, Callable[[Any, _Blobs], Any]] = {
    "i": lambda content, blobs: int(content, 16),
    "f": lambda content, blobs: _float_of(content),
    "c": lambda content, blobs: complex(_float_of(content[0]), _float_of(content[1])),
    "b": lambda content, blobs: bytes(blobs.take(content)),
    "w": lambda content, blobs: str(blobs.take(content), "utf-8", "surrogatepass"),
    "t": lambda content, blobs: tuple(_value(item, blobs) for item in content),
    "d": lambda content, blobs: {_value(key, blobs): _value(item, blobs) for key, item in content},
    "a": _array_of,
    "s": lambda content, blobs: _array_of(content, blobs)[()],
    "u": lambda content, blobs: np.str_(_value(content, blobs)),
    "y": lambda content, blobs: np.bytes_(bytes(blobs.take(content))),
    "p": lambda content, blobs: Path(content),
}


def _bits(value: float) -> str:
    return struct.pack("<d", value).hex()


def _float_of(bits: str) -> float:
    (value,) = struct.unpack("<d", bytes.fromhex(bits))
    return float(value)
