"""Smoothing of measured positions, without delay, as much as the data ask for."""

from __future__ import annotations

import numpy as np
from scipy.fft import dct, idct

from physx_core.typing import Vector

_TREND = 5  # degree
_WEAKEST, _STRONGEST, _STRENGTHS = -4.0, 14.0, 73  # powers of ten
_MEDIAN = 0.455  # of a squared normal variable


class Smoother:
    """A linear smoother that penalizes third differences, each joint by its own strength.

    The strength is that with the least expected error of accelerations (Stein's unbiased estimate),
    chosen once: what it makes of other positions is then linear in them.

    Attributes:
        noise: Standard deviation of white noise of each joint, as the highest frequencies show it.
    """

    def __init__(self, positions: Vector) -> None:
        """Choose the strengths for positions, shape (samples, joints)."""
        count = len(positions)
        # The cosine transform continues a signal by its mirror image; without trend, smoothly.
        basis = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, count), _TREND)
        self._basis = np.linalg.qr(basis)[0]
        second = (2 * np.sin(0.5 * np.pi * np.arange(count) / count)) ** 2
        waves = dct(positions - self._trend(positions), axis=0, norm="ortho")
        self._kept = np.empty(positions.shape)
        self.noise = np.sqrt(np.median(waves[-count // 4 :] ** 2, axis=0) / _MEDIAN)
        for joint, own in enumerate(waves.T):
            power = own**2
            noise = np.median(power[-count // 4 :]) / _MEDIAN

            def error(strength: float, power: Vector = power, noise: float = noise) -> float:
                kept = 1 / (1 + 10**strength * second**3)
                return float(np.sum(second**2 * ((1 - kept) ** 2 * power + 2 * kept * noise)))

            grid = np.linspace(_WEAKEST, _STRONGEST, _STRENGTHS)
            best = min(grid, key=error)
            self._kept[:, joint] = 1 / (1 + 10**best * second**3)

    def __call__(self, positions: Vector) -> Vector:
        """Return positions, shape (samples, joints), with less noise."""
        trend = self._trend(positions)
        waves = dct(positions - trend, axis=0, norm="ortho")
        found: Vector = trend + idct(self._kept * waves, axis=0, norm="ortho")
        return found

    def _trend(self, positions: Vector) -> Vector:
        found: Vector = self._basis @ (self._basis.T @ positions)
        return found
