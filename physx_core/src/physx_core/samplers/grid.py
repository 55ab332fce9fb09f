"""Grid: all combinations of evenly spaced values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.components.sampler import Sampler
from physx_core.errors import ConfigError, nearest


class Grid(Sampler):
    """All combinations of evenly spaced values, the last parameter varying fastest, repeatedly.

    Values are spaced evenly in the parameter's distribution: in their logarithms if it is
    ``log_uniform``. They include the bounds; a distribution without bounds is divided into
    intervals of equal probability, and the values are their medians.

    Attributes:
        count: Number of sets until the grid starts over.
    """

    def __init__(self, points: int | Mapping[str, int] = 10) -> None:
        """Store the numbers of points.

        Args:
            points: Number of values for each element of each parameter, or one by parameter name.
        """
        self._points = points
        self.count = 0

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Take the parameters: see `Sampler.begin`."""
        super().begin(parameters, seed)
        points, names = self._points, [parameter.name for parameter in parameters]
        if isinstance(points, Mapping):
            for name in (*points, *names):
                if name not in names or name not in points:
                    known = nearest(name, names) if name not in names else ""
                    raise ConfigError(
                        f'"physx/grid": points must name exactly the parameters {names}, but '
                        f'"{name}" is {"missing" if name in names else "none of them"}.{known}'
                    )
        self._levels: list[tuple[int, bool]] = []  # number of values, whether with the bounds
        for parameter in parameters:
            number = points[parameter.name] if isinstance(points, Mapping) else points
            if type(number) is not int or number < 1:
                raise ConfigError(
                    f'"physx/grid": the number of points of "{parameter.name}" is {number!r}; it '
                    "must be a whole number, at least 1."
                )
            self._levels += [(number, parameter.is_bounded and number > 1)] * parameter.size
        self.count = math.prod(number for number, _ in self._levels)

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set."""
        point, rest = np.empty(self.size), number % self.count
        for element in reversed(range(self.size)):
            count, with_bounds = self._levels[element]
            rest, place = divmod(rest, count)
            point[element] = _share(place, count) if with_bounds else (place + 0.5) / count
        return self.values(point)


def _share(place: int, count: int) -> float:
    """Return ``numpy.linspace(0, 1, count)[place]``, without the others."""
    return 1.0 if place == count - 1 else place * (1.0 / (count - 1))
