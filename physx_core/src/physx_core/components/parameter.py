"""Parameter: a property of a simulation that is chosen for each episode, with its distribution."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from physx_core import checks
from physx_core.errors import ConfigError
from physx_core.fields import RESERVED, Field
from physx_core.random_streams import first_numbers
from physx_core.typing import Array

if TYPE_CHECKING:
    from statistics import NormalDist

Distribution: TypeAlias = Literal["uniform", "log_uniform", "normal", "integer"]

SET_FIELDS = (
    Field("set", (), "int64", role="additional"),
    Field("env_id", (), "int32", role="additional"),
    Field("episode", (), "int64", role="additional"),
    Field("mode_index", (), "int8", role="additional"),
)
"""Fields of the dataset's record of sets, in addition to the parameters: the set's number, its
instance and episode, and the index of its rows' mode in `physx_core.config.MODES`."""

_DISTRIBUTIONS = ("uniform", "log_uniform", "normal", "integer")
_TAKEN = {*RESERVED, *(field.name for field in SET_FIELDS)}
_MOST_ELEMENTS = 2**16
_SMALLEST = 2.0**-53  # a normal distribution has no quantile of 0

Point: TypeAlias = Array
"""A point of the unit cube: for each element of each parameter, the cumulative probability of its
value."""


@dataclass(frozen=True)
class Parameter:
    """A property of a simulation: name, shape, and the distribution of its values.

    Bounds, mean and deviation are one number for all elements or an array of the parameter's shape;
    as attributes they are flat tuples, one number for each element.

    Attributes:
        name: Name, a Python identifier.
        low: Lower bound; None: none, for a normal distribution only.
        high: Upper bound; None: none, for a normal distribution only.
        shape: Shape of a value; ``()`` for a number.
        distribution: ``uniform``; ``log_uniform``, whose logarithm is uniform; ``normal``,
            truncated at the bounds, if any; or ``integer``, uniform, bounds included.
        mean: Mean of a normal distribution before truncation.
        deviation: Its standard deviation.
        unit: Unit of the values.
    """

    name: str
    low: Any = None
    high: Any = None
    shape: tuple[int, ...] = ()
    distribution: Distribution = "uniform"
    mean: Any = None
    deviation: Any = None
    unit: str = ""

    def __post_init__(self) -> None:
        """Check the options, and flatten bounds, mean and deviation to tuples.

        Raises:
            ConfigError: If the name is taken, a number is missing or not finite, or the bounds are
                not in order.
        """
        if self.distribution not in _DISTRIBUTIONS:
            raise self._error(
                f"has the unknown distribution {self.distribution!r}; use one of {_DISTRIBUTIONS}"
            )
        field = Field(self.name, self.shape, unit=self.unit)
        if self.name in _TAKEN:
            raise self._error("has a name that is reserved by physx")
        object.__setattr__(self, "shape", field.shape)
        if not 0 < self.size <= _MOST_ELEMENTS:
            raise self._error(f"has {self.size} elements, but must have 1 to {_MOST_ELEMENTS}")
        is_normal = self.distribution == "normal"
        for option in ("low", "high", "mean", "deviation"):
            object.__setattr__(self, option, self._flat(option))
            is_missing = getattr(self, option) is None
            if is_missing and is_normal == (option in ("mean", "deviation")):
                raise self._error(f'needs "{option}"')
            if not is_missing and not is_normal and option in ("mean", "deviation"):
                raise self._error(f'has a "{option}", which only a normal distribution has')
        self._check_order()

    def _flat(self, option: str) -> tuple[float, ...] | None:
        """Return an option with one finite number for each element."""
        given = getattr(self, option)
        if given is None:
            return None
        try:
            array = checks.array(option, given)
            is_flat = isinstance(given, tuple) and array.shape == (self.size,)
            flat = array if is_flat else np.broadcast_to(array, self.shape).ravel()
        except (ConfigError, ValueError):
            raise self._error(
                f'has "{option}" {given!r}, which is neither a number nor of shape {self.shape}'
            ) from None
        if not np.isfinite(flat).all():
            raise self._error(f'has "{option}" {given!r}, which is not finite')
        return tuple(flat.tolist())

    def _check_order(self) -> None:
        low, high = self.low, self.high
        if low is not None and high is not None and not np.all(np.less(low, high)):
            raise self._error(f"has bounds {self.low} and {self.high}: low must be below high")
        if self.distribution == "log_uniform" and np.min(low) <= 0:
            raise self._error("is log_uniform, so its lower bound must be above 0")
        if self.deviation is not None and np.min(self.deviation) <= 0:
            raise self._error("must have a deviation above 0")
        if self.distribution == "integer" and np.any(np.mod([low, high], 1)):
            raise self._error("has integer values, so its bounds must be integers")

    def _error(self, text: str) -> ConfigError:
        return ConfigError(f"The parameter {self.name!r} {text}.")

    @cached_property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    @property
    def columns(self) -> list[str]:
        """Names of its elements in a table: its own name, numbered if it has a shape."""
        if not self.shape:
            return [self.name]
        return [f"{self.name}_{element}" for element in range(self.size)]

    @property
    def field(self) -> Field:
        """The field of its values in a dataset."""
        dtype = "int64" if self.distribution == "integer" else "float64"
        return Field(self.name, self.shape, dtype, self.unit)

    def quantile(self, point: Point) -> Any:
        """Return the value with given cumulative probabilities, or several.

        Args:
            point: The probabilities, from 0 to 1, shape (size,), or (n, size) for n values.

        Returns:
            An array of the parameter's shape, or a number if that is ``()``; for several values an
            array with one more axis, the first.
        """
        low, high = np.asarray(self.low), np.asarray(self.high)
        if self.distribution == "normal":
            shares = point.reshape(-1, self.size).tolist()
            flat = np.array([[self._normal(n, s) for n, s in enumerate(one)] for one in shares])
        elif self.distribution == "log_uniform":
            flat = np.exp(np.log(low) + point * (np.log(high) - np.log(low)))
        elif self.distribution == "integer":
            flat = np.minimum(np.floor(low + point * (high - low + 1)), high).astype(np.int64)
        else:
            flat = low + point * (high - low)
        if self.distribution == "log_uniform":  # rounding may exceed the bounds
            flat = np.clip(flat, low, high)
        shape = point.shape[:-1] + self.shape
        return flat.reshape(shape) if shape else flat.item()

    def _normal(self, element: int, share: float) -> float:
        mean, deviation = self.mean[element], self.deviation[element]
        low = None if self.low is None else self.low[element]
        high = None if self.high is None else self.high[element]
        below = 0.0 if low is None else _standard().cdf((low - mean) / deviation)
        above = 1.0 if high is None else _standard().cdf((high - mean) / deviation)
        inside = min(max(below + share * (above - below), _SMALLEST), 1 - _SMALLEST)
        value: float = mean + deviation * _standard().inv_cdf(inside)
        value = value if low is None else max(value, low)
        return value if high is None else min(value, high)

    def share(self, value: Any) -> Point:
        """Return the cumulative probabilities of a value: the inverse of `quantile`.

        For an integer, this is the midpoint of the probabilities whose quantile it is.

        Args:
            value: A value of the parameter's shape.

        Returns:
            From 0 to 1, shape (size,).
        """
        flat = np.ravel(np.asarray(value, np.float64))
        low, high = np.asarray(self.low), np.asarray(self.high)
        if self.distribution == "normal":
            shares = np.array([self._below(n, number) for n, number in enumerate(flat.tolist())])
        elif self.distribution == "log_uniform":
            shares = (np.log(flat) - np.log(low)) / (np.log(high) - np.log(low))
        elif self.distribution == "integer":
            shares = (flat - low + 0.5) / (high - low + 1)
        else:
            shares = (flat - low) / (high - low)
        clipped: Point = np.clip(shares, 0.0, 1.0)
        return clipped

    def _below(self, element: int, value: float) -> float:
        inside, below, above = (
            bound
            if number is None
            else _standard().cdf((number - self.mean[element]) / self.deviation[element])
            for number, bound in (
                (value, 0.5),
                (None if self.low is None else self.low[element], 0.0),
                (None if self.high is None else self.high[element], 1.0),
            )
        )
        return (inside - below) / (above - below) if above > below else 0.5

    @property
    def is_bounded(self) -> bool:
        """Whether all values lie between two bounds."""
        return self.low is not None and self.high is not None

    def contains(self, value: Any) -> bool:
        """Return whether a value lies within the bounds, if any."""
        flat = np.ravel(value)
        return bool(
            (self.low is None or np.all(flat >= np.asarray(self.low)))
            and (self.high is None or np.all(flat <= np.asarray(self.high)))
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the parameter as plain data."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_dict(plain: Mapping[str, Any]) -> Parameter:
        """Create the parameter that plain data describes.

        Raises:
            ConfigError: If it does not describe a parameter.
        """
        try:
            return Parameter(**plain)
        except (TypeError, ValueError, MemoryError) as error:
            raise ConfigError(f"A description of a parameter is malformed: {error}.") from error


def as_parameters(given: Parameter | Iterable[Parameter]) -> list[Parameter]:
    """Return one parameter or several as a list.

    Raises:
        ConfigError: If something else is given.
    """
    parameters = [given] if isinstance(given, Parameter) else list(given)
    for parameter in parameters:
        if not isinstance(parameter, Parameter):
            raise ConfigError(
                f"define_parameters() got {parameter!r}: give Parameter(name, low, high), or "
                "several of them."
            )
    return parameters


def values_at(parameters: Sequence[Parameter], point: Point) -> dict[str, Any]:
    """Return the parameters' values at a point of the unit cube, or at several, by name.

    Args:
        parameters: The parameters.
        point: Shape (elements of all parameters,), or with one more axis, the first, for several.
    """
    values, first = {}, 0
    for parameter in parameters:
        values[parameter.name] = parameter.quantile(point[..., first : first + parameter.size])
        first += parameter.size
    return values


def random_of(entropy: int | Sequence[int], number: int, stream: int) -> np.random.Generator:
    """Return the random generator of a set of parameters, independent of all others.

    Args:
        entropy: Seed of the run.
        number: Number of the set.
        stream: Its purpose: 0 for the environment's episode, 1 for choosing the set.
    """
    return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=(number, stream)))


def draw(
    parameters: Sequence[Parameter], entropy: int | Sequence[int], number: int
) -> dict[str, Any]:
    """Return the values of a set, drawn from the parameters' distributions.

    Args:
        parameters: The parameters.
        entropy: Seed of the run.
        number: Number of the set.
    """
    size = sum(parameter.size for parameter in parameters)
    return values_at(parameters, random_of(entropy, number, 1).random(size))


def draw_many(
    parameters: Sequence[Parameter], entropy: int | Sequence[int], numbers: range
) -> dict[str, Any]:
    """Return what `draw` returns for each of several sets, as arrays with one more axis, the first.

    Args:
        parameters: The parameters.
        entropy: Seed of the run.
        numbers: Numbers of the sets.
    """
    size = sum(parameter.size for parameter in parameters)
    return values_at(parameters, first_numbers(entropy, numbers, 1, size))


@functools.cache
def _standard() -> NormalDist:
    from statistics import NormalDist  # it imports decimal and fractions

    return NormalDist()
