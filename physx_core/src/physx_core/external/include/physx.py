"""physx: sends the samples of a simulation in Python to physx.

It needs Python 3.8 and nothing else; NumPy arrays are welcome. A program of ``external/program``
finds it in its module path, so that any interpreter runs this, whether physx is installed or not:

    import physx

    run = physx.Run({"u": u, "t": 0.0})         # the fields of a sample, by values like theirs
    given = run.parameters(alpha=0.0, seed=0)   # parameters, again by values like theirs
    for step in range(100):
        ...                                     # simulate
        run.send(u=u, t=t)
    run.close()

Values are numbers, nested lists of numbers, or arrays. A number that can be a fraction is 0.0, not
0. When the run is over, the calls end the program: they raise `RunIsOver`. Only one thread at a
time may call them. For more, see docs/external.md of physx.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

_HEADER = struct.Struct("<4sHHQ")  # magic number, kind, number of arrays, bytes of their data
_DESCRIPTION = struct.Struct("<52sIiI8q")  # name, type, rank, whether it is requested, shape
_MAGIC = b"phy\1"
_FIELDS, _PARAMETERS, _SAMPLE, _PREDICT, _CLOSE, _ANSWER, _PART = range(1, 8)
_LETTERS = {
    "bool": "?", "int8": "b", "int16": "h", "int32": "i", "int64": "q", "uint8": "B",
    "uint16": "H", "uint32": "I", "uint64": "Q", "float32": "f", "float64": "d",
    "complex64": "ff", "complex128": "dd",
}  # fmt: skip
"""Type of numbers to what `struct` calls it."""
_OF_BUFFERS = {
    **{letter: name for name, letter in _LETTERS.items()},
    "l": "int64" if struct.calcsize("l") == 8 else "int32",
    "L": "uint64" if struct.calcsize("L") == 8 else "uint32",
    "Zf": "complex64",
    "Zd": "complex128",
}
_OF_NUMBERS = {bool: "bool", int: "int64", float: "float64", complex: "complex128"}


class RunIsOver(SystemExit):
    """The run needs no more samples. If nothing catches it, the program ends."""


class Array(NamedTuple):
    """The type and shape of an array, where there are no values like its own yet.

    Attributes:
        type: Name of the type of its numbers, for example "float32".
        shape: Its shape; None, of a field: that of the first sample.
    """

    type: str = "float64"
    shape: tuple[int, ...] | None = ()


class Run:
    """The connection to the run that started this program."""

    def __init__(
        self,
        fields: dict[str, Any],
        *,
        rank: int = 0,
        ranks: int = 1,
        offsets: dict[str, int] | None = None,
    ) -> None:
        """Connect, and declare the fields of a sample.

        Args:
            fields: A value like that of each field, or an `Array`.
            rank: Number of this process, from 0, if several send parts of each sample. All of them
                make the same calls in the same order then.
            ranks: Number of these processes.
            offsets: At which index of the first axis of the whole field this process's part
                begins, by the field's name. 0 if it is not given.

        Raises:
            RuntimeError: If no run has started this program, or it is over.
        """
        path = os.environ.get("PHYSX_SOCKET")
        if path is None:
            raise RuntimeError(
                "PHYSX_SOCKET is not set: this program was not started by a physx run"
            )
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(path)
        except OSError as error:
            raise RuntimeError(
                f"{error}: the run is over, or this program has already connected: each of several "
                "processes gives its rank"
            ) from None
        if ranks > 1:
            begins = [(offsets or {}).get(name, 0) for name in fields]
            self._say(_PART, {"part": [rank, ranks, *begins]}, {})
        self._say(_FIELDS, {}, fields)

    def parameters(self, **wanted: Any) -> dict[str, Any]:
        """Return parameters by name, in the types and shapes of the given values.

        A call after a sample begins a new episode, and waits until it is due.
        """
        return self._ask(_PARAMETERS, {}, wanted)

    def send(self, **sample: Any) -> None:
        """Send a sample: all fields. It is one step of the environment."""
        self._say(_SAMPLE, sample, {})

    def predict(self, inputs: dict[str, Any], outputs: dict[str, Any]) -> dict[str, Any]:
        """Return the network's prediction, in the types and shapes of the given outputs.

        Args:
            inputs: The network's input fields.
            outputs: A value like that of each field that it predicts, or an `Array`.
        """
        return self._ask(_PREDICT, inputs, outputs)

    def close(self) -> None:
        """Report that all samples have been sent. A program that ends without it has failed."""
        self._say(_CLOSE, {}, {})
        self._socket.close()

    def __enter__(self) -> Run:
        """Return this object."""
        return self

    def __exit__(self, kind: Any, *error: Any) -> None:
        """Close it, unless there was an error."""
        if kind is None:
            self.close()

    def _say(self, kind: int, given: dict[str, Any], wanted: dict[str, Any]) -> None:
        descriptions, contents = [], []
        for name, value in given.items():
            array, data = _read(name, value)
            descriptions.append(_describe(name, array, 0))
            contents.append(data)
        for name, value in wanted.items():
            descriptions.append(_describe(name, _like(name, value), 1))
        size = sum(map(len, contents))
        header = _HEADER.pack(_MAGIC, kind, len(descriptions), size)
        try:
            self._socket.sendall(b"".join([header, *descriptions, *contents]))
        except OSError:
            raise RunIsOver(0) from None

    def _ask(self, kind: int, given: dict[str, Any], wanted: dict[str, Any]) -> dict[str, Any]:
        self._say(kind, given, wanted)
        magic, answer, _, size = _HEADER.unpack(self._receive(_HEADER.size))
        if magic != _MAGIC or answer != _ANSWER:
            raise RuntimeError("the answer does not match the request")
        data, values = self._receive(size), {}
        for name, value in wanted.items():
            array = _like(name, value)
            own = data[: _size(array)]
            data = data[len(own) :]
            values[name] = _numpy(array, own) if _is_numpy(value) else _numbers(array, own)
        return values

    def _receive(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            try:
                more = self._socket.recv(size - len(data))
            except OSError:
                more = b""
            if not more:
                raise RunIsOver(0)
            data += more
        return bytes(data)


def _read(name: str, value: Any) -> tuple[Array, bytes]:
    """Return what an array is, and its data."""
    try:
        view = memoryview(value)
    except (TypeError, ValueError):
        shape, numbers = _flatten(name, value)
        kind = max(map(type, numbers), key=list(_OF_NUMBERS).index, default=float)
        array = Array(_OF_NUMBERS[kind], shape)
        if kind is complex:
            numbers = [part for number in numbers for part in (number.real, number.imag)]
        return array, struct.pack(f"<{len(numbers)}{_LETTERS[array.type][0]}", *numbers)
    known = _OF_BUFFERS.get(view.format.lstrip("<=@"))
    if known is None:
        raise TypeError(f"{name}: physx sends no numbers of the type {view.format!r}")
    return Array(known, view.shape), view.tobytes()


def _like(name: str, value: Any) -> Array:
    return value if isinstance(value, Array) else _read(name, value)[0]


def _flatten(name: str, value: Any) -> tuple[tuple[int, ...], list[Any]]:
    """Return the shape of nested lists, and their numbers."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if type(value) in _OF_NUMBERS:
        return (), [value]
    if not isinstance(value, (list, tuple)):
        raise TypeError(f"{name}: {value!r} is not a number, a list or an array")
    parts = [_flatten(name, each) for each in value]
    shapes = {shape for shape, _ in parts} or {()}
    if len(shapes) > 1:
        raise ValueError(f"{name}: the lists in it have different lengths")
    return (len(parts), *shapes.pop()), [number for _, numbers in parts for number in numbers]


def _describe(name: str, array: Array, wanted: int) -> bytes:
    if array.type not in _LETTERS:
        raise TypeError(f"{name}: the type must be one of {', '.join(_LETTERS)}")
    label = name.encode("ascii", "replace")
    axes = () if array.shape is None else array.shape
    if len(label) > 51 or len(axes) > 8:
        raise ValueError(f"{name}: names have up to 51 characters, arrays up to 8 axes")
    number = ord(array.type[0]) * 256 + struct.calcsize("<" + _LETTERS[array.type])
    rank = -1 if array.shape is None else len(axes)
    return _DESCRIPTION.pack(label, number, rank, wanted, *axes, *[0] * (8 - len(axes)))


def _size(array: Array) -> int:
    size = struct.calcsize("<" + _LETTERS[array.type])
    for axis in array.shape or ():
        size *= axis
    return size


def _is_numpy(value: Any) -> bool:
    return type(value).__module__ == "numpy"


def _numpy(array: Array, data: bytes) -> Any:
    import numpy

    return numpy.frombuffer(bytearray(data), array.type).reshape(array.shape)[()]


def _numbers(array: Array, data: bytes) -> Any:
    """Return a number, or nested lists of numbers."""
    numbers: list[Any] = [
        number[0] if len(number) == 1 else complex(*number)
        for number in struct.iter_unpack("<" + _LETTERS[array.type], data)
    ]
    return _nest(numbers, array.shape or ())


def _nest(numbers: Sequence[Any], shape: tuple[int, ...]) -> Any:
    if not shape:
        return numbers[0]
    step = len(numbers) // shape[0] if shape[0] else 0
    return [_nest(numbers[i * step : (i + 1) * step], shape[1:]) for i in range(shape[0])]
