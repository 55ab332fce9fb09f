"""Arrays, and their views, which stay views."""

from __future__ import annotations

from typing import Any

import numpy as np

from physx_core.errors import StateError
from physx_core.states.kind import PLAIN, Kind, Part, RefusedError, Value
from physx_core.typing import Array


class _Array(Kind):
    """An array that has its own memory; its axes stay in their order there."""

    def read(self, value: Any, part: Part) -> Any:
        if value.dtype.hasobject:
            raise RefusedError(f"of {value.dtype} cannot be captured")
        copied = np.array(value.transpose(_axes(value)), order="C")
        return copied if value.dtype.kind in PLAIN else copied.tobytes()

    def recipe(self, value: Any) -> Any:
        if value.size and type(value.base) not in (type(None), bytes, bytearray, memoryview):
            raise RefusedError(f"is memory of a {type(value.base).__name__}: store a copy of it")
        return [_axes(value), list(value.shape), _descr(value.dtype), value.flags.writeable]

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        axes, shape, descr, writeable = recipe
        lying = np.empty([shape[axis] for axis in axes], _dtype(descr))
        found = np.empty_like(lying.transpose(np.argsort(axes)))  # no view
        self.fill(found, content, value, frozenset())
        found.flags.writeable = writeable
        return found

    def fill(self, node: Any, content: Any, value: Value, kept: frozenset[str]) -> None:
        whole = node.transpose(_axes(node))
        if isinstance(content, bytes):
            content = np.frombuffer(content, node.dtype).reshape(whole.shape)
        if whole.shape != content.shape:
            raise StateError(f"The shape of an array was changed in place, to {content.shape}.")
        if node.flags.writeable:
            whole[...] = content
        elif whole.tobytes() != content.tobytes():
            node.flags.writeable = True
            node.transpose(_axes(node))[...] = content
            node.flags.writeable = False


class _View(Kind):
    """A view of an array, which has its content."""

    def read(self, value: Any, part: Part) -> Any:
        whole = _whole(value)
        offset = _address(value) - _address(whole)
        return [part(whole, ".base"), offset, str(value.strides), str(value.shape)]

    def recipe(self, value: Any) -> Any:
        return [
            list(value.shape),
            list(value.strides),
            _descr(value.dtype),
            value.flags.writeable,
        ]

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        whole, (shape, strides, descr, writeable) = value(content[0]), recipe
        whole = whole.transpose(_axes(whole))
        found: Array = np.ndarray(shape, _dtype(descr), whole, content[1], strides)
        found.flags.writeable &= writeable
        return found


class _Dtype(Kind):
    """A dtype, such as one that an object computes when it is first needed."""

    def recipe(self, value: Any) -> Any:
        if value.hasobject:
            raise RefusedError("was added after creation")
        return _descr(value)

    def make(self, recipe: Any, content: Any, value: Value) -> Any:
        return _dtype(recipe)


ARRAYS: dict[str, Kind] = {"array": _Array(), "view": _View(), "dtype": _Dtype()}


def _axes(array: Array) -> list[int]:
    """Return the axes from the longest to the shortest stride."""
    return sorted(range(array.ndim), key=lambda axis: -array.strides[axis])


def _whole(view: Any) -> Any:
    while type(view.base) is np.ndarray:
        view = view.base
    return view


def _address(array: Array) -> int:
    return int(array.__array_interface__["data"][0])


def _descr(dtype: np.dtype[Any]) -> Any:
    return dtype.str if dtype.kind in PLAIN else dtype.descr


def _dtype(descr: Any) -> Any:
    return np.dtype(descr if isinstance(descr, str) else [tuple(each) for each in descr])
