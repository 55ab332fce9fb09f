"""Pickling and copying of objects whose arrays are views of each other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray


class Window:
    """A view of an array, pickled with that array so that it is still a view when unpickled."""

    def __init__(self, whole: NDArray[Any], part: NDArray[Any]) -> None:
        self.whole = whole
        self.offset = _address(part) - _address(whole)
        self.shape, self.strides, self.dtype = part.shape, part.strides, part.dtype

    def open(self) -> NDArray[Any]:
        """Return the view."""
        return np.ndarray(self.shape, self.dtype, self.whole, self.offset, self.strides)


def whole_of(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array that another one is a part of, or that itself."""
    while type(array.base) is np.ndarray:
        array = array.base
    return array


def window_of(array: NDArray[Any]) -> Window | None:
    """Return an array as a part of the whole; None if it is the whole, or that is not its own."""
    whole = whole_of(array)
    owns = whole.base is None and whole.flags.c_contiguous
    return Window(whole, array) if owns and whole is not array else None


class SharedArrays:
    """An object whose views of its arrays, even in containers, stay views through pickling."""

    _left_out: ClassVar[frozenset[str]] = frozenset()
    """Attributes that are not pickled; they become None."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes, with windows instead of views."""
        kept = {name: value for name, value in vars(self).items() if name not in self._left_out}
        return {name: _close(value) for name, value in kept.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the attributes."""
        self.__dict__.update(dict.fromkeys(self._left_out))
        self.__dict__.update({name: _open(value) for name, value in state.items()})


def _close(value: Any) -> Any:
    """Return a value with windows instead of views."""
    if type(value) is not np.ndarray:
        return _map(_close, value)
    return window_of(value) or value


def _open(value: Any) -> Any:
    """Return a value with views instead of windows."""
    return value.open() if isinstance(value, Window) else _map(_open, value)


def _map(function: Callable[[Any], Any], value: Any) -> Any:
    """Apply a function to a container's values; return the container itself if none changes."""
    if type(value) is dict:
        changed = {key: function(each) for key, each in value.items()}
        same = all(changed[key] is each for key, each in value.items())
        return value if same else changed
    if type(value) in (list, tuple):
        found = [function(each) for each in value]
        same = all(new is old for new, old in zip(found, value, strict=True))
        return value if same else type(value)(found)
    return value


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])
