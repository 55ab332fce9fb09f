"""Pickling and copying objects whose arrays are parts of each other's memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray


class Window:
    """A part of an array's memory, written with the array; so it is a part of it again when read.

    Attributes:
        whole: The array that owns the memory.
        offset: Where the part begins, in bytes.
        shape: Of the part.
        strides: Of the part, in bytes.
        dtype: Of the part.
    """

    def __init__(self, whole: NDArray[Any], part: NDArray[Any]) -> None:
        self.whole = whole
        self.offset = _address(part) - _address(whole)
        self.shape, self.strides, self.dtype = part.shape, part.strides, part.dtype

    def open(self) -> NDArray[Any]:
        """Return the part of the array as it is now."""
        return np.ndarray(self.shape, self.dtype, self.whole, self.offset, self.strides)


class SharedArrays:
    """Pickled and copied with arrays that stay parts of each other, in attributes and containers.

    Subclasses name in `_left_out` what is made anew by whoever reads them.
    """

    _left_out: ClassVar[frozenset[str]] = frozenset()
    """Attributes that are not written."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes, parts of arrays as windows."""
        kept = {name: value for name, value in vars(self).items() if name not in self._left_out}
        return {name: _closed(value) for name, value in kept.items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take up the attributes; those that were not written are None."""
        self.__dict__.update(dict.fromkeys(self._left_out))
        self.__dict__.update({name: _opened(value) for name, value in state.items()})


def _closed(value: Any) -> Any:
    """Return a value with a window in the place of each part of another array."""
    if type(value) is not np.ndarray:
        return _mapped(_closed, value)
    whole = value
    while type(whole.base) is np.ndarray:
        whole = whole.base
    owns = whole.base is None and whole.flags.c_contiguous
    return Window(whole, value) if owns and whole is not value else value


def _opened(value: Any) -> Any:
    """Return a value with the parts of arrays in the place of their windows."""
    return value.open() if isinstance(value, Window) else _mapped(_opened, value)


def _mapped(function: Callable[[Any], Any], value: Any) -> Any:
    """Return a container with its values changed by a function; itself, where none changes."""
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
