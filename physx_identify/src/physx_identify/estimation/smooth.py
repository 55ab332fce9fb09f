"""Smoothing of measured positions, without delay, as much as the data ask for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from physx_core.typing import Array, Vector

_WEAKEST, _STRONGEST, _STRENGTHS = -4.0, 13.0, 69  # powers of ten
_MEDIAN = 0.455  # of a squared normal variable
_DIFFERENCE, _GROWTH = 5, 252.0
"""Order of the differences that show the noise, and by how much its variance is more in them."""


def white_noise(positions: Vector) -> Vector:
    """Return the standard deviation of white noise, as high differences show it, shape (joints,).

    Args:
        positions: Shape (samples, joints).
    """
    squares = np.diff(positions, _DIFFERENCE, axis=0) ** 2
    found: Vector = np.sqrt(np.median(squares, axis=0) / _MEDIAN / _GROWTH)
    return found


class Smoother:
    """A linear smoother that penalizes third differences, each joint by its own strength.

    The strength is that with the least expected error of accelerations (Stein's unbiased estimate),
    chosen once: what it makes of other positions is then linear in them.
    """

    def __init__(
        self, positions: Vector, kinks: Array | None = None, orders: Sequence[int] = ()
    ) -> None:
        """Choose the strengths.

        Args:
            positions: Shape (samples, joints).
            kinks: Samples at which the velocity may jump, shape (samples,); None: none.
            orders: Derivative that each of the first columns is instead of a position.
        """
        count = len(positions)
        self._free = np.zeros(count - 3, bool)
        if kinks is not None:
            self._free = kinks[1:-2] | kinks[2:-1]
        second = (2 * np.sin(0.5 * np.pi * np.arange(count) / count)) ** 2
        grid = 10 ** np.linspace(_WEAKEST, _STRONGEST, _STRENGTHS)
        more = [2 - order for order in (*orders, *[0] * (positions.shape[1] - len(orders)))]
        columns = list(zip(positions.T, white_noise(positions), more, strict=True))
        errors = []
        for strength in grid:
            factor, kept = self._factor(strength), 1 / (1 + strength * second**3)
            errors.append([
                np.sum(np.diff(own - self._smooth(own, factor), order) ** 2)
                + 2 * noise**2 * np.sum(kept * second**order)
                for own, noise, order in columns
            ])  # fmt: skip
        self._factors = [self._factor(grid[best]) for best in np.argmin(errors, axis=0)]

    def __call__(self, positions: Vector) -> Vector:
        """Return positions, shape (samples, joints), with less noise."""
        found = (self._smooth(*each) for each in zip(positions.T, self._factors, strict=True))
        return np.stack(list(found), axis=1)

    def _factor(self, strength: float) -> Vector:
        """Return the factor of 1 / strength and the product of third differences, banded."""
        band = np.zeros((4, len(self._free)))
        for row, weight in enumerate((20.0, -15.0, 6.0, -1.0)):
            kept = ~(self._free | np.roll(self._free, -row))
            band[row] = weight * kept
        band[0] += 1 / strength
        factor: Vector = cholesky_banded(band, lower=True, check_finite=False)
        return factor

    def _smooth(self, positions: Vector, factor: Vector) -> Vector:
        thirds = np.where(self._free, 0.0, np.diff(positions, 3))
        pulls = np.pad(cho_solve_banded((factor, True), thirds, check_finite=False), 3)
        found: Vector = positions + np.diff(pulls, 3)
        return found
