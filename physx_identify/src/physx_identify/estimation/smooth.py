"""Smoothing of measured positions, without delay, as much as the data ask for."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from physx_core.typing import Array, Vector

_ORDER = 3
"""Of the differences that are penalized."""
_WEAKEST, _STRONGEST, _STRENGTHS = -4.0, 13.0, 69  # powers of ten
_MEDIAN = 0.455  # of a squared normal variable
_HIGH, _GROWTH = 5, 252.0
"""Order of the differences that show white noise, and by how much its variance is more in them."""


def white_noise(values: Vector) -> Vector:
    """Return the standard deviation of white noise, whatever kinks values have, shape (columns,).

    Args:
        values: Shape (samples, columns).
    """
    squares = np.diff(values, _HIGH, axis=0) ** 2
    found: Vector = np.sqrt(np.median(squares, axis=0) / _MEDIAN / _GROWTH)
    return found


class Smoother:
    """A linear smoother that penalizes third differences, each joint by its own strength.

    The strength is that of generalized cross-validation (Craven and Wahba, Numerische Mathematik
    31, 1979), chosen once: what it makes of other positions is then linear in them. A log may begin
    and end in the middle of a motion.

    Attributes:
        noise: Standard deviation of white noise of each joint, as what is smoothed away shows it.
    """

    def __init__(self, positions: Vector, kinks: Array | None = None) -> None:
        """Choose the strengths.

        Args:
            positions: Shape (samples, joints).
            kinks: Samples at which velocities may jump, over which nothing is smoothed, shape
                (samples,); None: none.
        """
        count, joints = positions.shape
        self._free = np.zeros(count - _ORDER, bool)
        if kinks is not None:
            self._free = kinks[1:-2] | kinks[2:-1]
        strengths = np.logspace(_WEAKEST, _STRONGEST, _STRENGTHS)
        lefts, shares = np.empty((_STRENGTHS, joints)), np.empty((_STRENGTHS, 1))
        smoothed = 1 - self._free.mean()
        for row, strength in enumerate(strengths):
            left = positions - self._smooth(positions, self._factor(strength))
            lefts[row] = np.sum(left**2, axis=0)
            shares[row] = max(smoothed * _share(count, strength), 1e-9)
        best = np.argmin(lefts / shares**2, axis=0)
        self._factors = [self._factor(strength) for strength in strengths[best]]
        self.noise = np.sqrt(lefts[best, np.arange(joints)] / shares[best, 0])

    def __call__(self, positions: Vector) -> Vector:
        """Return positions, shape (samples, joints), with less noise."""
        pairs = zip(positions.T, self._factors, strict=True)
        found = [self._smooth(own[:, None], factor) for own, factor in pairs]
        return np.concatenate(found, axis=1)

    def _factor(self, strength: float) -> Vector:
        """Return the factor of 1 / strength and the product of third differences, banded."""
        band = np.zeros((_ORDER + 1, len(self._free)))
        for row, weight in enumerate((20.0, -15.0, 6.0, -1.0)):
            band[row] = weight * ~(self._free | np.roll(self._free, -row))
        band[0] += 1 / strength
        factor: Vector = cholesky_banded(band, lower=True, check_finite=False)
        return factor

    def _smooth(self, positions: Vector, factor: Vector) -> Vector:
        bent = np.where(self._free[:, None], 0.0, np.diff(positions, _ORDER, axis=0))
        pulls = cho_solve_banded((factor, True), bent, check_finite=False)
        found: Vector = positions + np.diff(np.pad(pulls, ((3, 3), (0, 0))), _ORDER, axis=0)
        return found


def _share(count: int, strength: float) -> float:
    """Return how many of a log's degrees of freedom are smoothed away, if there are no kinks.

    In cosine waves, the third differences of a signal that is continued by its mirror image are
    penalized; the two of them that a mirror image breaks, at the ends, are taken out by Woodbury's
    identity.
    """
    half = 0.5 * np.pi * np.arange(count) / count
    second = (2 * np.sin(half)) ** 2
    kept = 1 / (1 + strength * second**_ORDER)
    mirrored = np.stack([np.ones(count), np.cos(2 * half * count)], axis=1)  # at both ends
    breaks = np.sqrt(2 / count) * np.sin(2 * half)[:, None] * mirrored * [1, -1]
    ends = (kept * second ** (0.5 * _ORDER))[:, None] * breaks
    inside = strength * np.linalg.inv(breaks.T @ (kept[:, None] * breaks))
    return float(count - kept.sum() - np.sum(inside * (ends.T @ ends)))
