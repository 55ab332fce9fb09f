"""Mean, deviation, minimum, and maximum of the components of a field, which can be merged."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from physx_core.typing import Array

Doubles = NDArray[np.float64]
_WIDTH = 512
_NARROW = 16  # components
_QUIET = np.errstate(over="ignore", invalid="ignore")
_MERGEABLE = {"count", "mean", "squares", "minimum", "maximum"}


class RunningStatistics:
    """Mean, standard deviation, minimum, and maximum of all rows so far, in float64.

    They are those of each component, or of all components along some axes, which are 1 in their
    shape.

    Blocks are combined by the update of Chan, Golub and LeVeque (1979), "Updating formulae and a
    pairwise algorithm for computing sample variances". Values are relative to the first row, so a
    large offset costs no precision, and the deviation of a constant component is exactly 0. Where
    squares overflow, beyond about 1e150, the midpoint of minimum and maximum replaces the mean, and
    half their distance, an upper bound, replaces the deviation.

    Attributes:
        count: Number of rows so far.
    """

    def __init__(self, pooled: tuple[int, ...] = ()) -> None:
        """Start without rows.

        Args:
            pooled: Axes of a value to pool over.
        """
        self.count = 0
        self._pooled = pooled
        self._origin: Doubles = np.zeros(())
        self._mean: Doubles = np.zeros(())  # relative to the origin
        # Sum over the rows of squared deviations from the mean; of pooled ones, of their mean.
        self._squares: Doubles = np.zeros(())
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
            self._start_at(np.array(block[0][_leading(block.ndim - 1, self._pooled)], np.float64))
        self._widen(self._reduce(np.minimum, block), self._reduce(np.maximum, block))
        deviations = np.subtract(block, self._origin, dtype=np.float64)
        size = math.prod(block.shape[1 + axis] for axis in self._pooled)
        mean = self._reduce(np.add, deviations) / (count * size)
        deviations -= mean
        squares = self._reduce(np.add, np.square(deviations, out=deviations)) / size
        self._combine(count, mean, squares)

    def _reduce(self, function: np.ufunc, rows: Array) -> Array:
        found = _over_rows(function, rows)
        return np.asarray(function.reduce(found, axis=self._pooled, keepdims=True))

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

    @_QUIET
    def pool(self) -> RunningStatistics:
        """Return the statistics of all components together, of shape (1, ..., 1)."""
        found, means = RunningStatistics(), self.mean
        if not means.size:
            return self
        axes = tuple(range(means.ndim))
        found._start_at(means[(slice(1),) * means.ndim])
        found._mean = (means - found._origin).mean(axes, keepdims=True)
        squares = self._squares + self.count * (means - found._origin - found._mean) ** 2
        found._squares, found.count = squares.mean(axes, keepdims=True), self.count
        found._minimum = self._minimum.min(axes, keepdims=True)
        found._maximum = self._maximum.max(axes, keepdims=True)
        return found

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
        statistics._start_at(check_statistic("mean", arrays["mean"], shape))
        statistics._minimum = check_statistic("minimum", arrays["minimum"], shape)
        statistics._maximum = check_statistic("maximum", arrays["maximum"], shape)
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


class Cells(NamedTuple):
    """Statistics of several sets of rows, each apart, as `RunningStatistics.arrays` has them.

    Attributes:
        rows: Numbers of rows, int64, shape (cells,); 0: the others say nothing.
        mean, squares, minimum, maximum: float64, shape (*statistics shape, cells).
    """

    rows: NDArray[np.int64]
    mean: Doubles
    squares: Doubles
    minimum: Doubles
    maximum: Doubles

    @classmethod
    @_QUIET
    def of(cls, rows: Array, counts: NDArray[np.intp], pooled: tuple[int, ...] = ()) -> Cells:
        """Return the statistics of rows, of each cell only from its own.

        Args:
            rows: The rows of all cells, one cell after another, shape (rows, *field shape).
            counts: Numbers of rows, at least 1, shape (cells,).
            pooled: Axes of a value to pool over.
        """
        begins, shape = np.cumsum(counts) - counts, rows.shape[1:]
        if not 0 < math.prod(shape) <= _NARROW:  # reducing parts of an array is slow if it is wide
            parts = [rows[begin : begin + n] for begin, n in zip(begins, counts, strict=True)]
            return cls.joined([cls.one([part], pooled) for part in parts])

        def reduce(function: np.ufunc) -> Array:
            found: Array = function.reduceat(values, begins, -1)
            return np.asarray(function.reduce(found, axis=pooled, keepdims=True))

        values = np.ascontiguousarray(np.moveaxis(rows, 0, -1), np.float64)
        size = math.prod(shape[axis] for axis in pooled)
        low, high = reduce(np.minimum), reduce(np.maximum)
        origin = values[..., begins][_leading(len(shape), pooled)]
        values -= np.repeat(origin, counts, -1)
        mean = reduce(np.add) / (counts * size)
        values -= np.repeat(mean, counts, -1)
        np.square(values, out=values)
        squares, mean = reduce(np.add) / size, origin + mean
        mean = np.where(np.isfinite(mean), mean, low / 2 + high / 2)
        squares = np.where(np.isnan(squares), np.inf, squares)
        return cls(counts.astype(np.int64), mean, squares, low, high)

    @classmethod
    def one(cls, blocks: Iterable[Array], pooled: tuple[int, ...] = ()) -> Cells:
        """Return the statistics of a single cell, whose rows come in blocks."""
        running = RunningStatistics(pooled)
        for block in blocks:
            running.update(block)
        return cls(*(array[..., None] for array in running.arrays().values()))

    def empty(self) -> Cells:
        """Return a cell without rows, beside these."""
        return Cells(*(np.zeros((*column.shape[:-1], 1), column.dtype) for column in self))

    @classmethod
    def joined(cls, parts: Sequence[Cells]) -> Cells:
        """Return the cells of all parts, in order."""
        return cls(*(np.concatenate(columns, -1) for columns in zip(*parts, strict=True)))

    def take(self, index: NDArray[np.intp]) -> Cells:
        """Return some of the cells."""
        return Cells(self.rows[index], *(column.take(index, -1) for column in self[1:]))

    @_QUIET
    def merged(self) -> RunningStatistics:
        """Return the statistics of all rows; they depend on the cells and their order alone."""
        found = RunningStatistics()
        if not self.rows.all():
            return self.take(np.flatnonzero(self.rows)).merged()
        if not len(self.rows):
            return found
        found._start_at(self.mean[..., 0].copy())
        found.count = int(self.rows.sum())
        apart = self.mean - self.mean[..., :1]
        found._mean = np.asarray((self.rows * apart).sum(-1) / found.count)
        apart -= found._mean[..., None]
        found._squares = np.asarray((self.squares + self.rows * np.square(apart)).sum(-1))
        found._minimum, found._maximum = self.minimum.min(-1), self.maximum.max(-1)
        return found


def check_statistic(name: str, array: Array, shape: tuple[int, ...]) -> Doubles:
    """Return a copy of a statistic after checking its type, shape and values."""
    if array.dtype != np.float64 or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"the {name} is invalid")
    return array.copy()


def _leading(ndim: int, pooled: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the index of the first of the values that are pooled, of each component."""
    return tuple(slice(1) if axis in pooled else slice(None) for axis in range(ndim))


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
