"""Mean and standard deviation per component, accumulated block by block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from physx_core.fields import Array

Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of each component of a field.

    Attributes:
        mean: Mean, of the field's shape, float64, in the field's unit.
        std: Standard deviation, of the field's shape, float64, in the field's unit; 1 for a
            component that never changes, so that normalizing only shifts it to 0.
    """

    mean: Array
    std: Array

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON or TOML."""
        return {"mean": self.mean.tolist(), "std": self.std.tolist()}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Normalization:
        """Make what `to_dict` described."""
        return cls(np.asarray(plain["mean"], np.float64), np.asarray(plain["std"], np.float64))


class RunningStatistics:
    """Mean and standard deviation of the rows given so far, in float64.

    Blocks are combined by the update of Chan, Golub and LeVeque (1979), "Updating formulae and a
    pairwise algorithm for computing sample variances". Values are taken relative to the first row,
    so that a large offset costs no digits and a constant component has a deviation of exactly 0.

    Attributes:
        count: How many rows were given.
    """

    def __init__(self) -> None:
        self.count = 0
        self._origin: Doubles = np.zeros(())
        self._mean: Doubles = np.zeros(())  # relative to the origin
        self._squares: Doubles = np.zeros(())  # sum of squared deviations from the mean

    @property
    def mean(self) -> Doubles:
        """Mean of each component, of the field's shape, in the field's unit."""
        return np.asarray(self._origin + self._mean)

    @property
    def std(self) -> Doubles:
        """Standard deviation (of the population) of each component, in the field's unit."""
        return np.asarray(np.sqrt(self._squares / max(self.count, 1)))

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
        deviations = np.subtract(block, self._origin, dtype=np.float64)
        mean = deviations.mean(axis=0)
        deviations -= mean
        flat = deviations.reshape(count, -1)
        squares = np.einsum("ij,ij->j", flat, flat).reshape(self._mean.shape)
        self._combine(count, np.asarray(mean), squares)

    def merge(self, other: RunningStatistics) -> None:
        """Add the rows that `other` has seen."""
        if not other.count:
            return
        if not self.count:
            self._start_at(other._origin)
        mean = (other._origin - self._origin) + other._mean
        self._combine(other.count, np.asarray(mean), other._squares)

    def normalization(self) -> Normalization:
        """Return mean and deviation; 1 for components that differ by rounding errors at most."""
        mean, std = self.mean, self.std
        resolution = 4 * np.finfo(np.float64).eps * np.abs(mean)
        return Normalization(mean, np.where(std > resolution, std, 1.0))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {"count": self.count, "mean": self.mean.tolist(), "std": self.std.tolist()}

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Make what `to_dict` described."""
        statistics = cls()
        statistics._start_at(np.asarray(plain["mean"], np.float64))
        statistics.count = int(plain["count"])
        statistics._squares = np.asarray(plain["std"], np.float64) ** 2 * statistics.count
        return statistics

    def _start_at(self, origin: Doubles) -> None:
        self._origin = origin
        self._mean, self._squares = np.zeros(origin.shape), np.zeros(origin.shape)

    def _combine(self, count: int, mean: Doubles, squares: Doubles) -> None:
        total = self.count + count
        difference = mean - self._mean
        self._squares = self._squares + squares + difference**2 * (self.count * count / total)
        self._mean = self._mean + difference * (count / total)
        self.count = total
