"""Running mean, standard deviation, minimum, and maximum of each component of a field."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from physx_core.typing import Array

Doubles = NDArray[np.float64]
_WIDTH = 512
_QUIET = np.errstate(over="ignore", invalid="ignore")
_NORMALIZATION = ("mean", "std", "minimum", "maximum")
_MERGEABLE = {"count", "mean", "squares", "minimum", "maximum"}


@dataclass(frozen=True)
class Normalization:
    """Statistics of each component of a field; mean and standard deviation normalize it.

    Attributes:
        mean: Mean, of the field's shape, float64, in the field's unit.
        std: Standard deviation, of the field's shape, float64, in the field's unit; 1 for a
            constant component, so that normalization only shifts it to 0.
        minimum: Smallest value, of the field's shape, float64, in the field's unit; None if
            unknown.
        maximum: Largest value, like `minimum`.
    """

    mean: Array
    std: Array
    minimum: Array | None = None
    maximum: Array | None = None

    def arrays(self) -> dict[str, Array]:
        """Return the known statistics by name, for a file or another process."""
        known = ((name, getattr(self, name)) for name in _NORMALIZATION)
        return {name: values for name, values in known if values is not None}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], shape: tuple[int, ...]) -> Normalization:
        """Return the normalization that `arrays` described.

        Args:
            arrays: The statistics by name, possibly from an untrusted source.
            shape: Shape of the field.

        Raises:
            ValueError: If they are not the finite statistics of such a field.
        """
        if not {"mean", "std"} <= arrays.keys() <= set(_NORMALIZATION):
            raise ValueError(f"the statistics {sorted(arrays)} are not those of a normalization")
        return cls(**{name: _checked(name, array, shape) for name, array in arrays.items()})


class RunningStatistics:
    """Mean, standard deviation, minimum, and maximum of all rows so far, in float64.

    Blocks are combined by the update of Chan, Golub and LeVeque (1979), "Updating formulae and a
    pairwise algorithm for computing sample variances". Values are relative to the first row, so a
    large offset costs no precision, and the deviation of a constant component is exactly 0. Where
    squares overflow, beyond about 1e150, the midpoint of minimum and maximum replaces the mean, and
    half their distance, an upper bound, replaces the deviation.

    Attributes:
        count: Number of rows so far.
    """

    def __init__(self) -> None:
        self.count = 0
        self._origin: Doubles = np.zeros(())
        self._mean: Doubles = np.zeros(())  # relative to the origin
        self._squares: Doubles = np.zeros(())  # sum of squared deviations from the mean
        self._minimum: Doubles = np.zeros(())
        self._maximum: Doubles = np.zeros(())

    @property
    def mean(self) -> Doubles:
        """Mean of each component, of the field's shape, in the field's unit."""
        mean = self._origin + self._mean
        return np.where(np.isfinite(mean), mean, self._minimum / 2 + self._maximum / 2)

    @property
    def std(self) -> Doubles:
        """Population standard deviation of each component, in the field's unit."""
        std = np.sqrt(self._squares / max(self.count, 1))
        return np.where(np.isfinite(std), std, self._maximum / 2 - self._minimum / 2)

    @property
    def minimum(self) -> Doubles:
        """Smallest value of each component, in the field's unit."""
        return self._minimum

    @property
    def maximum(self) -> Doubles:
        """Largest value of each component, in the field's unit."""
        return self._maximum

    @_QUIET
    def update(self, block: Array) -> None:
        """Add rows.

        Args:
            block: Values of shape (rows, *field shape), real and finite.
        """
        count = len(block)
        if not count:
            return
        if not self.count:
            self._start_at(np.array(block[0], np.float64))
        self._widen(_over_rows(np.minimum, block), _over_rows(np.maximum, block))
        deviations = np.subtract(block, self._origin, dtype=np.float64)
        mean = _over_rows(np.add, deviations) / count
        deviations -= mean
        squares = _over_rows(np.add, np.square(deviations, out=deviations))
        self._combine(count, mean, squares)

    @_QUIET
    def merge(self, other: RunningStatistics) -> None:
        """Add the rows that `other` has seen.

        The result is the same whether either has been through `arrays` before.
        """
        if not other.count:
            return
        mean = other.mean
        if not self.count:
            self._start_at(mean)
            self._minimum, self._maximum = other._minimum, other._maximum
        self._origin, self._mean = self.mean, np.zeros(mean.shape)  # as after `arrays`
        self._widen(other._minimum, other._maximum)
        self._combine(other.count, np.asarray(mean - self._origin), other._squares)

    def normalization(self) -> Normalization:
        """Return the normalization; the deviation is 1 where values differ only by rounding."""
        mean, std = self.mean, self.std
        resolution = 4 * np.finfo(np.float64).eps * np.abs(mean)
        std = np.where(std > resolution, std, 1.0)
        return Normalization(mean, std, self._minimum, self._maximum)

    def arrays(self) -> dict[str, Array]:
        """Return all that is needed to merge them, by name, for a file or another process.

        Returns:
            ``count``, int64, of shape (); ``mean``, ``squares`` (the sum of squared deviations from
            the mean), ``minimum`` and ``maximum``, float64, of the field's shape. Squares that
            overflow are infinite.
        """
        squares = np.where(np.isnan(self._squares), np.inf, self._squares)
        return {
            "count": np.array(self.count, np.int64),
            "mean": self.mean,
            "squares": squares,
            "minimum": self._minimum,
            "maximum": self._maximum,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array], shape: tuple[int, ...]) -> Self:
        """Return the statistics that `arrays` described.

        Args:
            arrays: The arrays by name, possibly from an untrusted source.
            shape: Shape of the field.

        Raises:
            ValueError: If they are not statistics of such a field.
        """
        if arrays.keys() != _MERGEABLE:
            raise ValueError(f"{sorted(arrays)} are not statistics that can be merged")
        count, squares = arrays["count"], arrays["squares"]
        if count.dtype != np.int64 or count.shape != () or not 0 < count < 2**62:
            raise ValueError("the count is invalid")
        if squares.dtype != np.float64 or squares.shape != shape or not (squares >= 0).all():
            raise ValueError("the squares are invalid")
        statistics = cls()
        statistics._start_at(_checked("mean", arrays["mean"], shape))
        statistics._minimum = _checked("minimum", arrays["minimum"], shape)
        statistics._maximum = _checked("maximum", arrays["maximum"], shape)
        statistics._squares, statistics.count = squares.copy(), int(count)
        return statistics

    def _start_at(self, origin: Doubles) -> None:
        self._origin = origin
        self._mean, self._squares = np.zeros(origin.shape), np.zeros(origin.shape)
        self._minimum = self._maximum = origin

    def _widen(self, minimum: Array, maximum: Array) -> None:
        self._minimum = np.minimum(self._minimum, minimum, dtype=np.float64)
        self._maximum = np.maximum(self._maximum, maximum, dtype=np.float64)

    def _combine(self, count: int, mean: Doubles, squares: Doubles) -> None:
        total = self.count + count
        difference = mean - self._mean
        self._squares = self._squares + squares + difference**2 * (self.count * count / total)
        self._mean = self._mean + difference * (count / total)
        self.count = total


def _checked(name: str, array: Array, shape: tuple[int, ...]) -> Doubles:
    """Return a copy of a statistic after checking its type, shape and values."""
    if array.dtype != np.float64 or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"the {name} is invalid")
    return array.copy()


def _over_rows(function: np.ufunc, rows: Array) -> Array:
    """Reduce an array over its rows, several narrow rows at a time for speed."""
    count, shape = len(rows), rows.shape[1:]
    width = math.prod(shape)
    fold = max(1, min(_WIDTH // max(width, 1), count))
    whole = count // fold * fold
    wide = rows[:whole].reshape(whole // fold, fold * width)
    found: Array = function.reduce(wide, axis=0).reshape(fold, *shape)
    found = np.concatenate([found, rows[whole:]]) if whole < count else found
    return np.asarray(function.reduce(found, axis=0))
