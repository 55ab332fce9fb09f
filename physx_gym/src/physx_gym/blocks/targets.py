"""Targets that follow accelerations and never leave their bounds."""

from __future__ import annotations

import numpy as np
from numpy import add, fmax, fmin, multiply, negative, sqrt, subtract

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.shared_arrays import SharedArrays

_ROUNDING = 1e-12
"""Relative amount by which rounding may carry a target beyond a bound."""


class Targets(SharedArrays):
    """Positions and velocities that follow accelerations, each held for a period.

    In each period the velocity changes first, then the position: ``v += a * dt; q += v * dt``.
    Position, velocity and acceleration stay within bounds, and the velocity is always such that the
    target can stop before the bound of its position. At a distance d from that bound, it is at most
    ``sqrt(2 * a_max * d) - a_max * dt / 2``: one period of full braking leads from this curve
    exactly back to it. So a target comes to rest at most ``a_max * dt² / 8`` before a bound.

    Attributes:
        state: Negative positions, positions, velocities; shape (3, n).
        positions: The targets, shape (n,), in rad or m; a part of `state`.
        velocities: Their velocities, shape (n,), in rad/s or m/s; a part of `state`.
        pair: Positions and velocities, shape (2, n); a part of `state`.
    """

    def __init__(
        self,
        lower: Vector,
        upper: Vector,
        max_velocity: Vector,
        max_acceleration: Vector,
    ) -> None:
        """Set the bounds, all of shape (n,); only positions and velocities may be unbounded.

        Raises:
            ConfigError: If the bounds are reversed, or an acceleration is not bounded.
        """
        n = len(lower)
        if not (lower <= upper).all():
            raise ConfigError(f"The lower bounds {lower} of targets are above the upper {upper}.")
        if not (np.isfinite(max_acceleration) & (max_acceleration > 0)).all():
            raise ConfigError(
                f"Accelerations of targets need finite positive bounds, not {max_acceleration}."
            )
        self.lower, self.upper, self.max_velocity = lower, upper, max_velocity
        bounds = np.array([-lower, upper])
        self.state = np.zeros((3, n))
        self._bounds = bounds + _ROUNDING * (1 + np.where(np.isfinite(bounds), abs(bounds), 0.0))
        self.max_acceleration = max_acceleration
        self._double = np.array([2 * max_acceleration] * 2)
        self._half = np.zeros((2, n))
        self._zero = np.zeros((2, n))
        self._fastest = np.array([max_velocity] * 2)
        self._period = np.zeros(n)
        self._room, self._change = np.zeros((2, n)), np.zeros(n)
        self.positions, self.velocities = self.state[1], self.state[2]
        self.pair, self._both = self.state[1:], self.state[:2]
        self._parts = (*self._room, self.state[0], self.positions, self.velocities)

    def set_period(self, period: float) -> None:
        """Set the time for which each acceleration is held, in s; call it before `start`."""
        self._period[:] = period
        self._half[:] = 0.5 * period * self.max_acceleration

    @property
    def bounds(self) -> tuple[Vector, Vector]:
        """Lowest and highest values of `pair`, shape (2, n) each; never exceeded."""
        fastest = self.max_velocity
        low = np.array([-self._bounds[0] - abs(self._bounds[0]) * _ROUNDING, -fastest])
        high = np.array([self._bounds[1] + abs(self._bounds[1]) * _ROUNDING, fastest])
        return low, high

    def start(self, positions: Vector, velocities: Vector) -> None:
        """Begin at the positions and velocities within the bounds nearest to the given ones."""
        self.positions[:] = np.clip(positions, self.lower, self.upper)
        self.state[0] = -self.positions
        self._find_room()
        self.velocities[:] = np.clip(velocities, -self._room[0], self._room[1])

    def step(self, acceleration: Vector) -> None:
        """Advance by one period.

        Args:
            acceleration: Shape (n,), in rad/s² or m/s², within their bounds; the other bounds hold
                for any accelerations.
        """
        self._find_room()
        backward, forward, opposite, positions, velocities = self._parts
        change, period = self._change, self._period
        multiply(acceleration, period, change)
        add(velocities, change, velocities)
        fmin(velocities, forward, velocities)
        negative(backward, change)
        fmax(velocities, change, velocities)
        multiply(velocities, period, change)
        add(positions, change, positions)
        negative(positions, opposite)

    def _find_room(self) -> None:
        """Compute the highest velocities in both directions from which targets can still stop."""
        room = self._room
        subtract(self._bounds, self._both, room)
        multiply(room, self._double, room)
        sqrt(room, room)
        subtract(room, self._half, room)
        fmax(room, self._zero, room)
        fmin(room, self._fastest, room)
