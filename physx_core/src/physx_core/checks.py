"""Validates the options of a description; each error names the option."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from physx_core.errors import ConfigError


def finite(option: str, value: Any) -> float:
    """Return a value as a finite float.

    Raises:
        ConfigError: If it is not a finite number.
    """
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{option} is {value!r} but must be a finite number.")
    return number


def positive(option: str, value: Any) -> float:
    """Return a value as a finite float above 0.

    Raises:
        ConfigError: If it is not a finite number above 0.
    """
    number = finite(option, value)
    if not number > 0:
        raise ConfigError(f"{option} is {value!r} but must be positive.")
    return number


def not_negative(option: str, value: Any) -> float:
    """Return a value as a finite float of at least 0.

    Raises:
        ConfigError: If it is not a finite number of at least 0.
    """
    number = finite(option, value)
    if number < 0:
        raise ConfigError(f"{option} is {value!r} but must not be negative.")
    return number


def options(check: Callable[[str, Any], float], where: str, description: Any, *names: str) -> None:
    """Check options of a description.

    Args:
        check: One of the functions above.
        where: Prefix of the options' names in an error.
        description: The object with the options.
        names: Names of the options.

    Raises:
        ConfigError: If an option is out of range.
    """
    for name in names:
        check(where + name, getattr(description, name))


def vector(option: str, values: Any, length: int) -> tuple[float, ...]:
    """Return values as a tuple of `length` finite floats.

    Raises:
        ConfigError: If they are not `length` finite numbers.
    """
    try:
        numbers = tuple(values)
    except TypeError:
        raise ConfigError(f"{option} is {values!r} but needs {length} numbers.") from None
    if len(numbers) != length:
        raise ConfigError(f"{option} has {len(numbers)} numbers but needs {length}.")
    return tuple(finite(option, number) for number in numbers)


def unit_quaternion(option: str, values: Sequence[float]) -> tuple[float, ...]:
    """Return a quaternion x, y, z, w, scaled to length 1.

    Raises:
        ConfigError: If it does not consist of four finite numbers, or its length differs from 1 by
            more than 0.001.
    """
    quaternion = vector(option, values, 4)
    length = math.sqrt(sum(part * part for part in quaternion))
    if abs(length - 1.0) > 1e-3:
        raise ConfigError(
            f"{option}, a quaternion in the order x, y, z, w, has length {length:g}, not 1."
        )
    return tuple(part / length for part in quaternion)


def name(kind: str, value: Any) -> str:
    """Return a name: a nonempty string without ``/``, which separates names in a state.

    Raises:
        ConfigError: If the value is not such a string.
    """
    if not isinstance(value, str) or not value or "/" in value:
        raise ConfigError(
            f"The name of a {kind} is {value!r} but must be a nonempty string without '/'."
        )
    return value
