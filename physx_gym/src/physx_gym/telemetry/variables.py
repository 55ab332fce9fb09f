"""Variables of the telemetry: nested arrays, the names of their numbers, and their memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError
from physx_gym.shared_arrays import SharedArrays
from physx_gym.spaces import Path, leaves, map_leaves, value_at

Array = NDArray[Any]

TYPES = ("float64", "int64")
"""Types of the numbers that can be recorded."""


@dataclass(frozen=True)
class Variable(SharedArrays):
    """A registered variable.

    Attributes:
        name: Its name, with the namespace.
        value: The user's arrays, nested in dictionaries and sequences.
        fieldnames: Names of its columns, nested likewise.
        arrays: The arrays in the order of the columns.
        columns: Names of the columns of each array.
        units: Units of the columns; empty if unknown.
        is_eval_only: Whether it is recorded in evaluation only.
    """

    name: str
    value: Any
    fieldnames: Any
    arrays: tuple[Array, ...]
    columns: tuple[tuple[str, ...], ...]
    units: tuple[str, ...]
    is_eval_only: bool

    @classmethod
    def of(
        cls,
        name: str,
        value: Any,
        fieldnames: Any,
        namespace: str | None,
        unit: str | Sequence[str],
        is_eval_only: bool,
    ) -> Variable:
        """Check a variable and name its columns; see `Telemetry.register`."""
        for text in (name, namespace):
            if not isinstance(text, (str, type(None))):
                raise ConfigError(f"The name of a variable must be a string, not {text!r}.")
        full = f"{namespace}.{name}" if namespace else name
        if not name:
            raise ConfigError("A telemetry variable needs a name.")
        arrays = dict(leaves(value))
        names = {path: _names(full, path, each, fieldnames) for path, each in arrays.items()}
        size = sum(each.size for each in names.values())
        units = (unit,) * size if isinstance(unit, str) else tuple(unit)
        if len(units) != size:
            raise ConfigError(f'"{full}" has {size} numbers, but {len(units)} units.')
        return cls(
            full,
            value,
            map_leaves(lambda path, _: names[path].tolist(), value),
            tuple(arrays.values()),
            tuple(tuple(each.ravel().tolist()) for each in names.values()),
            units,
            is_eval_only,
        )

    def is_same(self, other: Variable) -> bool:
        """Return whether another variable has the same arrays under the same names."""
        same = len(self.arrays) == len(other.arrays) and self.columns == other.columns
        pairs = zip(self.arrays, other.arrays, strict=True) if same else ()
        return same and all(_memory(mine) == _memory(its) for mine, its in pairs)


def _names(name: str, path: Path, array: Any, fieldnames: Any) -> Array:
    """Return the names of an array's numbers as an array of its shape."""
    prefix = ".".join([name, *map(str, path)])
    _check_array(prefix, array)
    if fieldnames is None:
        numbers = np.ndindex(array.shape)
        flat = [".".join([prefix, *map(str, number)]) for number in numbers]
    else:
        try:
            own = value_at(fieldnames, path)
        except (KeyError, IndexError, TypeError) as error:
            raise ConfigError(
                f'The fieldnames of "{name}" lack {".".join(map(str, path))!r}: they must be '
                "nested like the value."
            ) from error
        flat = [f"{name}.{each}" for each in _flatten(own, name, array)]
    named = np.empty(array.size, object)
    named[:] = flat
    return named.reshape(array.shape)


def _check_array(where: str, value: Any) -> None:
    if not isinstance(value, np.ndarray):
        raise ConfigError(
            f'"{where}" is {value!r}, a {type(value).__name__}. Variables are registered by '
            "reference: keep the numbers in an array of float64 or int64, and register that."
        )
    if value.dtype.name not in TYPES or not value.dtype.isnative:
        raise ConfigError(
            f'"{where}" is an array of {value.dtype}; only float64 and int64 can be recorded. '
            "Keep the numbers in an array of one of these types, and register that."
        )


def _flatten(fieldnames: Any, name: str, array: Array) -> Sequence[str]:
    """Return the names of an array's numbers.

    They are a string for a single number, nested sequences of the array's shape, or a flat sequence
    for all numbers.
    """
    names = np.array([fieldnames] if isinstance(fieldnames, str) else fieldnames, object)
    fits = names.shape == array.shape or (names.ndim == 1 and names.size == array.size)
    if not fits:
        raise ConfigError(
            f'"{name}" has an array of shape {array.shape}, but fieldnames of shape {names.shape}.'
        )
    flat: list[Any] = names.ravel().tolist()
    wrong = [each for each in flat if not isinstance(each, str) or not each]
    if wrong:
        raise ConfigError(f'A fieldname of "{name}" is {wrong[0]!r}, not a string.')
    return flat


# Memory -------------------------------------------------------------------------------------

WORD = np.dtype(np.int64)
"""Type that numbers are copied as: 8 bytes, regardless of their meaning."""


def words_of(arrays: Iterable[Array]) -> list[NDArray[np.int64]]:
    """Return as few one-dimensional views as possible of all numbers of arrays, in order."""
    found: list[NDArray[np.int64]] = []
    for view in (view for array in arrays for view in _flat_views(array) if view.size):
        both = _join(found[-1], view) if found else None
        if both is None:
            found.append(view)
        else:
            found[-1] = both
    return found


def _flat_views(array: Array) -> Iterator[NDArray[np.int64]]:
    if array.ndim <= 1 or array.flags.c_contiguous:
        yield array.reshape(-1).view(WORD)
    else:
        for part in array:
            yield from _flat_views(part)


def _join(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """Return two views as one if they are adjacent in the memory of one array."""
    owner, step = _owner(first), WORD.itemsize
    if _owner(second) is not owner or not owner.flags.c_contiguous or owner.itemsize != step:
        return None
    if any(view.size > 1 and view.strides != (step,) for view in (first, second)):
        return None
    begin = _address(first) - _address(owner)
    if _address(second) - _address(owner) != begin + first.size * step:
        return None
    words = owner.reshape(-1).view(WORD)
    return words[begin // step : begin // step + first.size + second.size]


def _owner(array: Array) -> Array:
    while type(array.base) is np.ndarray:
        array = array.base
    return array


def _memory(array: Array) -> tuple[Any, ...]:
    return _address(array), array.shape, array.strides


def _address(array: Array) -> int:
    return int(array.__array_interface__["data"][0])
