"""Parameters: the values that the settings of a study can take."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.config import at_least, from_plain, options
from physx_core.errors import ConfigError

Setting = dict[str, Any]
"""Name of a parameter to its value."""

MOST = 100_000
"""Largest number of trials of a study; each is a process and a folder."""


@dataclass(frozen=True)
class Choices:
    """A parameter that takes one of several values.

    Attributes:
        values: The values, as in TOML.
    """

    values: tuple[Any, ...]

    def count(self, where: str) -> int:
        """Return the number of values for a grid."""
        return len(self.values)

    def grid(self) -> Sequence[Any]:
        """Return the values for a grid."""
        return self.values

    def draw(self, random: np.random.Generator) -> Any:
        """Return a random value."""
        return self.values[int(random.integers(len(self.values)))]

    def ends(self) -> Sequence[Any]:
        """Return all values."""
        return self.values


@options
@dataclass(frozen=True)
class Range:
    """A parameter that takes numbers in a range; integers if both ends are.

    Attributes:
        low: Smallest value.
        high: Largest value.
        log: Whether to distribute the logarithms evenly instead of the numbers.
        num: Number of values in a grid.
    """

    low: int | float
    high: int | float
    log: bool = False
    num: int | None = at_least(2, None)

    def __post_init__(self) -> None:
        """Validate the ends.

        Raises:
            ConfigError: If the range is empty, or `log` is set and `low` is not positive.
        """
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ConfigError(f"low is {self.low} and must be below high, which is {self.high}.")
        if self.log and self.low <= 0:
            raise ConfigError(f"low is {self.low} and must be positive where log is true.")

    @property
    def is_whole(self) -> bool:
        """Whether the numbers are integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    def count(self, where: str) -> int:
        """Return the number of values for a grid, without making more than `MOST` of them.

        Args:
            where: The parameter, for messages.

        Raises:
            ConfigError: If the range does not set it.
        """
        if self.num is None:
            raise ConfigError(f"{where}: a grid needs the number of values: add num = 5.")
        return self.num if self.num > MOST else len(self.grid())

    def grid(self) -> Sequence[Any]:
        """Return the values for a grid; integers that round alike are one."""
        space = np.geomspace if self.log else np.linspace
        numbers = space(self.low, self.high, self.num or 0)
        return list(dict.fromkeys(self._value(number) for number in numbers))

    def draw(self, random: np.random.Generator) -> Any:
        """Return a random value."""
        low, high = self.low, self.high
        if self.is_whole:  # each integer gets the interval within 0.5 of it
            low, high = low - 0.5, high + 0.5
        if self.log:
            return self._value(math.exp(random.uniform(math.log(low), math.log(high))))
        return self._value(random.uniform(low, high))

    def ends(self) -> Sequence[Any]:
        """Return the smallest and the largest value."""
        return (self.low, self.high)

    def _value(self, number: float) -> float | int:
        clipped = min(max(float(number), self.low), self.high)
        return round(clipped) if self.is_whole else float(clipped)


Parameter = Choices | Range


def read_parameters(where: str, table: Mapping[str, Any]) -> dict[str, Parameter]:
    """Return a table's parameters by the dotted path of the option that each sets.

    A list contains the values of a parameter. A table whose ``low`` or ``high`` is a number is a
    range. Any other table is part of a path.

    Args:
        where: The table and its file, for messages.
        table: The table, as in TOML.

    Raises:
        ConfigError: If an entry is neither.
    """
    found: dict[str, Parameter] = {}
    for path, value in _leaves(table):
        if isinstance(value, list) and value:
            found[path] = Choices(tuple(value))
        elif isinstance(value, Mapping):
            try:
                found[path] = from_plain(Range, value)
            except ConfigError as error:
                raise ConfigError(f"{where}: {path}: {error}") from None
        else:
            raise ConfigError(
                f"{where}: {path} is {value!r} and must be a list of values, as in [0.1, 0.01], or "
                "a range, as in { low = 1e-4, high = 0.1, log = true }."
            )
    return found


def _leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in table.items():
        is_table = isinstance(value, Mapping) and value
        if is_table and not any(_is_number(value.get(end)) for end in ("low", "high")):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def count_grid(where: str, parameters: Mapping[str, Parameter]) -> int:
    """Return the number of combinations of the parameters' values, without building them.

    Args:
        where: The file, for messages.
        parameters: The parameters by name.

    Raises:
        ConfigError: If a range does not set its number of values for a grid.
    """
    return math.prod(each.count(f"{where}: {name}") for name, each in parameters.items())


def grid_of(parameters: Mapping[str, Parameter]) -> list[Setting]:
    """Return all combinations of the parameters' values; the last parameter varies fastest."""
    values = [parameter.grid() for parameter in parameters.values()]
    return [dict(zip(parameters, each, strict=True)) for each in itertools.product(*values)]
