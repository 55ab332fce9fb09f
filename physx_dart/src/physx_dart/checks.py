"""Checks of what callers give to a simulation; each error names it."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from physx_core.errors import SimulationError
from physx_core.interfaces.backend import Vector

_LARGEST = 1e100
"""Length of vectors from which their products overflow."""


def vector(name: str, given: ArrayLike, length: int) -> Vector:
    """Return finite numbers as a new vector of a length.

    Raises:
        SimulationError: They are none.
    """
    try:
        numbers = np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise SimulationError(f"{name} are no numbers: {error}.") from error
    if numbers.shape != (length,):
        raise SimulationError(f"{name} have the shape {numbers.shape} but need ({length},).")
    if not math.hypot(*numbers.tolist()) < _LARGEST:
        raise SimulationError(f"{name} must be finite numbers below {_LARGEST:g}, not {numbers}.")
    return numbers


def rows(name: str, given: ArrayLike, width: int) -> Vector:
    """Return finite numbers as an array of shape (any, width).

    Raises:
        SimulationError: They are none.
    """
    try:
        numbers = np.array(given, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise SimulationError(f"{name} are no numbers: {error}.") from error
    fits = numbers.ndim == 2 and numbers.shape[1] == width
    if not fits or not (np.abs(numbers) < _LARGEST).all():
        raise SimulationError(
            f"{name} have the shape {numbers.shape} but need (n, {width}), finite numbers."
        )
    return numbers


def integer(name: str, given: Any, least: int) -> int:
    """Return an integer that is not below a bound.

    Raises:
        SimulationError: It is none.
    """
    try:
        number = operator.index(given)
    except TypeError:
        raise SimulationError(f"{name} is {given!r} but must be an integer.") from None
    if number < least:
        what = "cannot be negative" if least == 0 else f"must be at least {least}"
        raise SimulationError(f"{name} is {number}: it {what}.")
    return number


def joined(parts: Sequence[Vector], out: Vector | None = None) -> Vector:
    """Return vectors one after the other, written into `out` if it is given.

    Raises:
        SimulationError: `out` does not fit.
    """
    whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
    if out is None:
        return whole
    if not isinstance(out, np.ndarray):
        raise SimulationError(f"out is {type(out).__name__} but must be a NumPy array.")
    if out.shape != whole.shape or out.dtype != np.float64 or not out.flags.writeable:
        raise SimulationError(
            f"out has the shape {out.shape} and type {out.dtype} but needs {whole.shape} and "
            "float64, writeable."
        )
    out[:] = whole
    return out
