"""Smooth random motions: sums of sines around a center."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from physx_core.typing import Vector


@dataclass(frozen=True)
class SmoothTrajectory:
    """A motion ``center + fade(t) * (sum over k of amplitude_k * sin(rate_k * t + phase_k))``.

    `fade` rises from 0 to 1 as the polynomial 10 s³ - 15 s⁴ + 6 s⁵, so the motion starts at the
    center, at rest and without acceleration.

    Attributes:
        center: Shape (n,), in the joints' units.
        amplitudes: Amplitude of each sine, shape (terms, n), in the joints' units.
        rates: Angular frequencies, shape (terms, n), in rad/s.
        phases: Shape (terms, n), in rad.
        fade_time: Duration of the fade-in, in s; 0: none.
    """

    center: Vector
    amplitudes: Vector
    rates: Vector
    phases: Vector
    fade_time: float

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        center: Vector,
        amplitude: Vector,
        frequencies: tuple[float, float],
        *,
        terms: int = 3,
        fade_time: float = 0.0,
    ) -> Self:
        """Draw a motion that stays within `amplitude` of the center.

        Args:
            rng: Source of random numbers.
            center: Shape (n,).
            amplitude: Sum of the sine amplitudes, shape (n,).
            frequencies: Lowest and highest frequency, in Hz.
            terms: Number of sines.
            fade_time: Duration of the fade-in, in s.
        """
        shape = (terms, len(center))
        shares = rng.uniform(0.2, 1.0, shape)
        rates = 2 * np.pi * rng.uniform(*frequencies, shape)
        phases = rng.uniform(0.0, 2 * np.pi, shape)
        return cls(center, amplitude * shares / shares.sum(axis=0), rates, phases, fade_time)

    def at(self, time: float) -> tuple[Vector, Vector, Vector]:
        """Return position, velocity, and acceleration at a time in s, each of shape (n,)."""
        q, v, a = self.along(np.array([time]))
        return q[0], v[0], a[0]

    def along(self, times: Vector) -> tuple[Vector, Vector, Vector]:
        """Return positions, velocities, and accelerations at times (m,), each of shape (m, n)."""
        angle = self.rates * times[:, None, None] + self.phases
        sine, cosine = self.amplitudes * np.sin(angle), self.amplitudes * np.cos(angle)
        q, v = sine.sum(axis=1), (self.rates * cosine).sum(axis=1)
        a = -(self.rates**2 * sine).sum(axis=1)
        if self.fade_time:
            f, df, ddf = self._fade(times[:, None])
            q, v, a = f * q, f * v + df * q, f * a + 2 * df * v + ddf * q
        return self.center + q, v, a

    def _fade(self, times: Vector) -> tuple[Vector, Vector, Vector]:
        """Return the fade-in factor and its first two derivatives."""
        s = np.clip(times / self.fade_time, 0.0, 1.0)
        return (
            s**3 * (10 - 15 * s + 6 * s**2),
            s**2 * (30 - 60 * s + 30 * s**2) / self.fade_time,
            s * (60 - 180 * s + 120 * s**2) / self.fade_time**2,
        )
