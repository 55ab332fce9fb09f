"""Reads NumPy arrays from untrusted pickles.

A pickle is a program that may call anything. Here its calls only reach stand-ins: each name is
looked up in a table of the few that NumPy itself writes for an array, and the stand-in only records
its arguments. The array is then built from type, shape and bytes. No function of NumPy or of any
other library is called with arguments from the pickle.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from physx_core.typing import Array

_MOST_OPERATIONS = 100
"""Limit on the operations of an array's pickle: NumPy writes about 60."""
_MOST_CALLS = 6
_OPERATIONS = {
    "PROTO", "FRAME", "STOP", "GLOBAL", "STACK_GLOBAL", "REDUCE", "BUILD", "MARK", "NONE",
    "NEWTRUE", "NEWFALSE", "MEMOIZE", "BINPUT", "BINGET", "BININT", "BININT1", "BININT2", "LONG1",
    "EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3",
    "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8",
    "BYTEARRAY8",
}  # fmt: skip
"""Operations in the pickles that NumPy writes. LONG_BINPUT, whose argument determines how much
memory is allocated, is not among them."""
_KIND = re.compile(r"[biufc]\d{1,2}")
_SHAPE_LENGTH = 64


class ArrayPickleError(ValueError):
    """A pickle is damaged or holds anything but an array of plain numbers."""


def load_array(content: bytes) -> Array:
    """Return the NumPy array or number in a pickle of protocol 2 to 5.

    Raises:
        ArrayPickleError: If the pickle is damaged or holds anything else.
    """
    try:
        _check_operations(content)
        found = _ArrayUnpickler(content).load()
    except ArrayPickleError:
        raise
    except Exception as error:  # a damaged pickle may raise anything
        raise ArrayPickleError(f"its pickle is damaged: {str(error)[:200]}") from error
    if not isinstance(found, _Array):
        raise ArrayPickleError(f"its pickle holds a {type(found).__name__}, not an array")
    try:
        return found.make()
    except (TypeError, ValueError, OverflowError) as error:
        raise ArrayPickleError(f"it has an impossible type or shape: {str(error)[:200]}") from error


def _check_operations(content: bytes) -> None:
    """Check the program's length, number of calls, and operations."""
    calls = 0
    for number, (operation, _, _) in enumerate(pickletools.genops(content)):
        calls += operation.name == "REDUCE"
        if operation.name not in _OPERATIONS or number > _MOST_OPERATIONS or calls > _MOST_CALLS:
            raise ArrayPickleError("its pickle holds more than an array of numbers")


class _ArrayUnpickler(pickle.Unpickler):
    def __init__(self, content: bytes) -> None:
        super().__init__(io.BytesIO(content))

    def find_class(self, module: str, name: str) -> Any:
        """Return the stand-in for a name that NumPy writes; other names are errors."""
        if (module, name) not in _NAMES:
            raise ArrayPickleError(
                f'its pickle names "{module}.{name}", which an array of numbers does not need'
            )
        return _StandIn(_KNOWN[name])


class _StandIn:
    """Stands in for a function or class; a pickle can call it but not modify it."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)

    def __setstate__(self, state: Any) -> None:
        raise ArrayPickleError("its pickle changes a function")


class _Type:
    """Number type as described by a pickle."""

    __slots__ = ("_kind", "_order")

    def __init__(self, kind: Any) -> None:
        self._kind, self._order = kind, "|"

    def __setstate__(self, state: Any) -> None:
        _, self._order, subarray, names, fields, *_ = state
        if subarray is not None or names is not None or fields is not None:
            self._kind = "records"

    def make(self) -> np.dtype[Any]:
        """Return the type."""
        if not isinstance(self._kind, str) or not _KIND.fullmatch(self._kind):
            raise ArrayPickleError(f"it holds {self._kind!r:.40}, not plain numbers")
        order = self._order if self._order in ("<", ">") else "="
        return np.dtype(f"{order}{self._kind}")


class _Array:
    """Array as described by a pickle."""

    __slots__ = ("_content", "_is_columnwise", "_shape", "_type")

    def __init__(self) -> None:
        self._shape: Any = ()
        self._type: Any = None
        self._is_columnwise: Any = False
        self._content: Any = b""

    def __setstate__(self, state: Any) -> None:
        _, self._shape, self._type, self._is_columnwise, self._content = state

    @classmethod
    def of_buffer(cls, content: Any, type_: Any, shape: Any, order: Any) -> _Array:
        """Return the array that ``numpy._frombuffer`` would make."""
        found = cls()
        found.__setstate__((1, shape, type_, order == "F", content))
        return found

    @classmethod
    def of_number(cls, type_: Any, content: Any) -> _Array:
        """Return the array that ``numpy.scalar`` would make."""
        return cls.of_buffer(content, type_, (), "C")

    def make(self) -> Array:
        """Return the array."""
        if not isinstance(self._type, _Type) or not isinstance(self._content, (bytes, bytearray)):
            raise ArrayPickleError("it holds Python objects, not plain numbers")
        dtype, shape = self._type.make(), self._shape
        if not isinstance(shape, tuple) or len(shape) > _SHAPE_LENGTH:
            raise ArrayPickleError("it has no shape")
        if any(type(length) is not int or length < 0 for length in shape):
            raise ArrayPickleError("it has an impossible shape")
        if math.prod(shape) * dtype.itemsize != len(self._content):
            raise ArrayPickleError(f"it has {len(self._content)} bytes for the shape {shape}")
        flat: Array = np.frombuffer(self._content, dtype)
        if self._is_columnwise is True:
            return flat.reshape(shape[::-1]).T
        return flat.reshape(shape)


def _encode(text: Any, encoding: Any = None) -> bytes:
    """Return the bytes that protocol 2 writes as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise ArrayPickleError("its bytes are not encoded as bytes")
    return text.encode("latin-1")


def _no_bytes(*args: Any) -> bytes:
    """Return the empty bytes, which protocol 2 writes as a call."""
    if args:
        raise ArrayPickleError("its bytes are not encoded as bytes")
    return b""


_KNOWN: dict[str, Callable[..., Any]] = {
    "_reconstruct": lambda *args: _Array(),
    "_frombuffer": _Array.of_buffer,
    "scalar": _Array.of_number,
    "dtype": lambda kind, *args: _Type(kind),
    "ndarray": _no_bytes,
    "encode": _encode,
    "bytes": _no_bytes,
}
_NAMES = {
    *(("numpy", name) for name in ("ndarray", "dtype")),
    *((f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")),
    *((f"numpy.{core}.multiarray", "scalar") for core in ("core", "_core")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("_codecs", "encode"),
    ("__builtin__", "bytes"),
    ("builtins", "bytes"),
}
