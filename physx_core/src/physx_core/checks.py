"""Validates the options of a description; each error names the option.

A description stores each number as the type that it declares, whatever type was given: see
`store_declared`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import operator
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from physx_core.errors import ConfigError

if TYPE_CHECKING:
    from physx_core.typing import Vector

_T = TypeVar("_T")
Convert = Callable[[str, Any], Any]
"""Returns a value as the declared type, given the option's name and the value."""


def number(option: str, value: Any) -> float:
    """Return a real number as a float.

    Accepted are Python's numbers, `Fraction` and `Decimal` included, and NumPy's; arrays and
    tensors without axes count as the number that they hold. Booleans and text are no numbers.

    Raises:
        ConfigError: If it is not a real number, or is too large for a float.
    """
    if type(value) is float:
        return value
    scalar = _scalar(value)
    if not isinstance(scalar, (bool, str, bytes, bytearray)):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            return float(scalar)
    raise ConfigError(f"{option} is {value!r} but must be a number.")


def integer(option: str, value: Any) -> int:
    """Return an integer, of Python or NumPy, as an int; see `number`.

    Raises:
        ConfigError: If it is of another type, even if its value is whole.
    """
    if type(value) is int:
        return value
    scalar = _scalar(value)
    if not isinstance(scalar, bool):
        with contextlib.suppress(TypeError):
            return int(operator.index(scalar))
    raise ConfigError(f"{option} is {value!r} but must be an integer.")


def boolean(option: str, value: Any) -> bool:
    """Return a boolean, of Python or NumPy, as a bool.

    Raises:
        ConfigError: If it is of another type.
    """
    scalar = _scalar(value)
    if isinstance(scalar, bool):
        return scalar
    raise ConfigError(f"{option} is {value!r} but must be True or False.")


def array(option: str, values: Any) -> Vector:
    """Return real numbers as a new float64 array, read-only.

    Raises:
        ConfigError: If they are ragged, or are not numbers in the sense of `number`.
    """
    import numpy as np  # not needed to read a configuration

    try:
        given = np.asarray(values)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise ConfigError(f"{option} must be numbers: {error}.") from error
    if given.dtype.kind == "O":  # fractions, integers beyond 64 bits
        flat = [number(option, each) for each in given.ravel()]
        found = np.array(flat, np.float64).reshape(given.shape)
    elif given.dtype.kind in "iuf":
        with np.errstate(over="ignore"):
            found = given.astype(np.float64)
    else:
        raise ConfigError(f"{option} must be numbers, not {given.dtype}.")
    found.flags.writeable = False
    return found


def _scalar(value: Any) -> Any:
    """Return the Python value of a NumPy scalar, or of an array or tensor without axes."""
    if getattr(value, "ndim", None) != 0 or not hasattr(value, "item"):
        return value
    kind = getattr(value.dtype, "kind", "")
    return None if kind in ("m", "M") else value.item()  # a time would become an integer


def store_declared(where: str, description: Any) -> None:
    """Store each number of a dataclass as the type that its annotation declares.

    Numbers in tuples, lists, mappings and arrays are stored likewise: a ``Mapping[str, float]`` as
    a new dict of floats, a ``Sequence[float]`` as a tuple, an ``NDArray`` as a new read-only array.
    What is no number by its annotation stays as it is.

    Args:
        where: Prefix of the options' names in an error.
        description: The dataclass; it may be frozen.

    Raises:
        ConfigError: If a value is not of the declared kind: see `number`, `integer`, `boolean`.
    """
    cls: Any = type(description)
    for name, convert in _conversions(cls):
        given = getattr(description, name)
        stored = convert(where + name, given)
        if stored is not given:
            object.__setattr__(description, name, stored)


def conversions(cls: Any) -> tuple[tuple[str, Convert], ...]:
    """Return the options of a dataclass that hold numbers, and the conversion of each.

    Args:
        cls: The dataclass.
    """
    return _conversions(cls)


@functools.cache
def _conversions(cls: Any) -> tuple[tuple[str, Convert], ...]:
    hints = _hints(cls)
    found = ((f.name, _conversion(hints.get(f.name))) for f in dataclasses.fields(cls) if f.init)
    return tuple((name, convert) for name, convert in found if convert is not None)


def _hints(cls: type[Any]) -> dict[str, Any]:
    """Return the annotations of a class, or of the nearest base whose annotations are defined."""
    for base in cls.__mro__:
        with contextlib.suppress(NameError):  # a name imported only for type checkers
            return typing.get_type_hints(base)
    return {}


def _conversion(hint: Any) -> Convert | None:
    """Return the conversion to an annotated type; None if the type contains no numbers."""
    scalars: dict[Any, Convert] = {float: number, int: integer, bool: boolean}
    if hint in scalars:
        return scalars[hint]
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _any_of(parts)
    if not isinstance(origin, type) or not parts:
        return None
    if origin.__name__ == "ndarray":
        return array if "float64" in repr(parts[-1]) else None
    if issubclass(origin, Mapping):
        convert = _conversion(parts[-1])
        return convert and functools.partial(_mapping, convert)
    if issubclass(origin, Sequence):
        convert = _conversion(parts[0])
        return convert and functools.partial(_sequence, list if origin is list else tuple, convert)
    return None


def _mapping(convert: Convert, option: str, values: Any) -> dict[Any, Any]:
    if not isinstance(values, Mapping):
        raise ConfigError(f"{option} is {values!r} but must be a mapping from names to values.")
    return {key: convert(f'{option}["{key}"]', value) for key, value in values.items()}


def _sequence(make: type[Any], convert: Convert, option: str, values: Any) -> Any:
    if not _is_sequence(values):
        raise ConfigError(f"{option} is {values!r} but must be a sequence of numbers.")
    return make(convert(f"{option}[{place}]", value) for place, value in enumerate(values))


def _is_sequence(value: Any) -> bool:
    is_text_or_table = isinstance(value, (str, bytes, bytearray, Mapping))
    return hasattr(value, "__iter__") and not is_text_or_table and getattr(value, "ndim", 1) > 0


def _any_of(hints: Sequence[Any]) -> Convert | None:
    """Return the conversion to the first of several types that fits a value."""
    arms = [convert for convert in map(_conversion, hints) if convert is not None]
    if not arms:
        return None
    takes_none = type(None) in hints
    takes_others = len(arms) + takes_none < len(hints)

    def convert(option: str, value: Any) -> Any:
        if value is None and takes_none:
            return None
        errors = []
        for arm in arms:
            try:
                return arm(option, value)
            except ConfigError as error:
                errors.append(error)
        if takes_others and not hasattr(value, "__float__"):  # text, for example, or a class
            return value
        raise errors[-1 if _is_sequence(value) or isinstance(value, Mapping) else 0]

    return convert


def finite(option: str, value: Any) -> float:
    """Return a value as a finite float.

    Raises:
        ConfigError: If it is not a finite number.
    """
    try:
        found = number(option, value)
    except ConfigError:
        found = math.nan
    if not math.isfinite(found):
        raise ConfigError(f"{option} is {value!r} but must be a finite number.")
    return found


def positive(option: str, value: Any) -> float:
    """Return a value as a finite float above 0.

    Raises:
        ConfigError: If it is not a finite number above 0.
    """
    found = finite(option, value)
    if not found > 0:
        raise ConfigError(f"{option} is {value!r} but must be positive.")
    return found


def not_negative(option: str, value: Any) -> float:
    """Return a value as a finite float of at least 0.

    Raises:
        ConfigError: If it is not a finite number of at least 0.
    """
    found = finite(option, value)
    if found < 0:
        raise ConfigError(f"{option} is {value!r} but must not be negative.")
    return found


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


def things(option: str, values: Any, kind: type[_T]) -> tuple[_T, ...]:
    """Return a sequence of objects of a class as a tuple.

    Raises:
        ConfigError: If it is no sequence, or one of the objects is of another class.
    """
    name = kind.__name__
    wanted = f"{option} must be a list of {name}s, as in [{name}(...)]"
    if not _is_sequence(values):
        raise ConfigError(f"{wanted}, not {values!r}.")
    found = tuple(values)
    for each in found:
        if not isinstance(each, kind):
            raise ConfigError(f"{wanted}; {each!r} is not a {name}.")
    return found


def names(option: str, values: Any) -> tuple[str, ...]:
    """Return a sequence of names as a tuple.

    Raises:
        ConfigError: If it is no sequence of strings.
    """
    found = tuple(values) if _is_sequence(values) else (None,)
    if not all(isinstance(each, str) for each in found):
        raise ConfigError(f"{option} is {values!r}, not a list of names.")
    return found


def scaled(values: tuple[float, ...], length: float) -> tuple[float, ...]:
    """Return a vector of a given length, scaled to length 1; one of length 1 is not changed."""
    if math.isclose(length, 1.0, rel_tol=1e-15):  # else reading a stored one would change it
        return values
    return tuple(part / length for part in values)


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
    return scaled(quaternion, length)


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
