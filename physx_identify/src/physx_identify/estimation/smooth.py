"""Smoothing of measured positions, without delay, as much as the data ask for."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct, idct

from physx_core.typing import Vector

_ORDER = 3
"""Of the differences that are penalized."""
_WEAKEST, _STRONGEST, _STRENGTHS = -4.0, 14.0, 73  # powers of ten


class Smoother:
    """A linear smoother that penalizes third differences, each joint by its own strength.

    The strength is that of generalized cross-validation (Craven and Wahba, Numerische Mathematik
    31, 1979), chosen once: what it makes of other positions is then linear in them.

    In cosine waves, the third differences of a signal that is continued by its mirror image are
    penalized; the two of them that a mirror image breaks, at the ends, are taken out by Woodbury's
    identity, so that a log may begin and end in the middle of a motion.

    Attributes:
        noise: Standard deviation of white noise of each joint, as what is smoothed away shows it.
    """

    def __init__(self, positions: Vector) -> None:
        """Choose the strengths for positions, shape (samples, joints)."""
        count = len(positions)
        half = 0.5 * np.pi * np.arange(count) / count
        self._second = (2 * np.sin(half)) ** 2
        mirrored = np.stack([np.ones(count), np.cos(2 * half * count)], axis=1)  # at both ends
        self._breaks = np.sqrt(2 / count) * np.sin(2 * half)[:, None] * mirrored * [1, -1]
        waves = dct(positions, axis=0, norm="ortho")
        strengths = np.logspace(_WEAKEST, _STRONGEST, _STRENGTHS)
        lefts, shares = np.empty((_STRENGTHS, positions.shape[1])), np.empty((_STRENGTHS, 1))
        for row, strength in enumerate(strengths):
            kept, ends, inside = self._parts(strength)
            left = waves - kept[:, None] * waves - ends @ (inside @ (ends.T @ waves))
            lefts[row] = np.sum(left**2, axis=0)
            shares[row] = count - kept.sum() - np.sum(inside * (ends.T @ ends))
        best = np.argmin(lefts / shares**2, axis=0)
        self._chosen = strengths[best]
        self.noise = np.sqrt(lefts[best, np.arange(len(best))] / shares[best, 0])

    def _parts(self, strength: float) -> tuple[Vector, Vector, Vector]:
        """Return what is kept of waves: diagonal + ends @ inside @ ends.T."""
        kept = 1 / (1 + strength * self._second**_ORDER)
        ends = (kept * self._second ** (0.5 * _ORDER))[:, None] * self._breaks
        inside = strength * np.linalg.inv(self._breaks.T @ (kept[:, None] * self._breaks))
        return kept, ends, inside

    def __call__(self, positions: Vector) -> Vector:
        """Return positions, shape (samples, joints), with less noise."""
        waves = dct(positions, axis=0, norm="ortho")
        for joint, strength in enumerate(self._chosen):
            kept, ends, inside = self._parts(strength)
            own = waves[:, joint]
            waves[:, joint] = kept * own + ends @ (inside @ (ends.T @ own))
        found: Vector = idct(waves, axis=0, norm="ortho")
        return found
