"""Checks and joins of what goes through a simulation."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.errors import SimulationError
from physx_core.typing import Vector


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


def joined(parts: Sequence[Vector]) -> Vector:
    """Return vectors one after the other."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
