"""Validation of arrays that callers pass to a simulation; each error names the array."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from physx_core.typing import Vector
from physx_sim.errors import SimulationError

LARGEST = 1e100
"""Length above which products of vectors overflow."""
_LARGEST_SQUARE = LARGEST**2
_FLOAT = np.dtype(np.float64)


def finite_vector(name: str, given: Any, length: int) -> Vector:
    """Return finite numbers as a new vector of a given length.

    Raises:
        SimulationError: If they are not `length` finite numbers.
    """
    plain = type(given) is np.ndarray and given.dtype is _FLOAT
    numbers = given.copy() if plain else _numbers(name, given)
    if numbers.shape != (length,):
        raise SimulationError(f"{name} have the shape {numbers.shape} but need ({length},).")
    if not numbers.dot(numbers) < _LARGEST_SQUARE:
        raise SimulationError(f"{name} must be finite numbers below {LARGEST:g}, not {numbers}.")
    return numbers


def finite_rows(name: str, given: ArrayLike, width: int) -> Vector:
    """Return finite numbers as a new array of shape (any, width).

    Raises:
        SimulationError: If they are not finite numbers of that shape.
    """
    numbers = _numbers(name, given)
    fits = numbers.ndim == 2 and numbers.shape[1] == width
    if not fits or not (np.abs(numbers) < LARGEST).all():
        raise SimulationError(
            f"{name} have the shape {numbers.shape} but need (n, {width}), finite numbers."
        )
    return numbers


def _numbers(name: str, given: ArrayLike) -> Vector:
    try:
        return np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise SimulationError(f"{name} are not numbers: {error}.") from error


def overwrite(name: str, target: Vector, given: Any) -> None:
    """Write finite numbers into a vector; on an error it stays unchanged.

    Raises:
        SimulationError: If the numbers are not finite, or not as many as the vector has entries.
    """
    fits = type(given) is np.ndarray and given.dtype is _FLOAT and given.shape == target.shape
    if fits and given.dot(given) < _LARGEST_SQUARE:
        target[:] = given
    else:
        target[:] = finite_vector(name, given, len(target))


def copy_to(whole: Vector, out: Vector) -> Vector:
    """Copy a vector to `out` and return `out`.

    Raises:
        SimulationError: If `out` does not fit.
    """
    if not isinstance(out, np.ndarray):
        raise SimulationError(f"out is {type(out).__name__} but must be a NumPy array.")
    if out.shape != whole.shape or out.dtype != _FLOAT or not out.flags.writeable:
        raise SimulationError(
            f"out has the shape {out.shape} and type {out.dtype} but needs {whole.shape} and "
            "float64, writable."
        )
    out[:] = whole
    return out
