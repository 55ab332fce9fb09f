"""Newton's method for impulses of points with friction cones and of rows with bounds."""

from __future__ import annotations

import math

import numpy as np

from physx_core.typing import Vector

_REGULARIZATION = 1e-9
"""Relative addition to the diagonal, as in DART's solver."""
_STUCK = 1e-14
"""Response, relative to the largest, below which nothing can move in a direction."""
_ACCURACY = 1e-11
"""Of velocities, in m/s, for free velocities of 1 m/s or less."""


class ContactProblem:
    """The problem of finding the impulses that prevent penetration and keep rows in their bounds.

    A point's impulse is within its friction cone and opposes sliding (Coulomb's law); a row's
    impulse is within its bounds, and the velocity of a row that is at none of them is 0. Such
    impulses are fixed points of a step against the velocities followed by a projection onto cones
    and bounds. This equation is piecewise smooth: Newton's method solves it exactly once it has
    found which points stick, slide, or separate (P. Alart and A. Curnier, A mixed
    formulation for frictional contact problems prone to Newton like solution methods, Computer
    Methods in Applied Mechanics and Engineering 92, 1991).

    Attributes:
        matrix: Velocities for unit impulses, shape (3 k + m, 3 k + m).
        free: Velocities without impulses minus the wanted ones, shape (3 k + m,): of k points along
            two tangents and the normal, then of m rows.
        friction: Coefficients of the points, shape (k,).
        least: Smallest impulses of the rows, shape (m,).
        most: Largest impulses, likewise.
        accuracy: Error from which impulses count as exact.
    """

    def __init__(
        self, response: Vector, free: Vector, friction: Vector, least: Vector, most: Vector
    ) -> None:
        """Set up the problem, with a diagonal that is slightly larger than that of `response`.

        A direction in which nothing can move, as across a rail, gets no impulse, as any would do.
        """
        diagonal = (1 + _REGULARIZATION) * response.diagonal()
        largest = float(diagonal.max(initial=0.0)) or 1.0
        stuck = diagonal <= _STUCK * largest
        self.matrix = response.copy()
        self.matrix.flat[:: len(free) + 1] = np.where(stuck, largest, diagonal)
        self.free = np.where(stuck, 0.0, free)
        self.friction, self.least, self.most = friction, least, most
        steps = 1 / self.matrix.diagonal()
        self._size = 3 * len(friction)
        blocks = steps[: self._size].reshape(-1, 3)
        blocks[:] = blocks.min(axis=1, keepdims=True)
        self._steps = steps
        self._scaled = steps[:, None] * self.matrix
        self._coefficients = friction.tolist()
        self.accuracy = _ACCURACY * max(1.0, float(np.abs(free).max()))

    def error(self, impulses: Vector) -> float:
        """Return the distance of impulses from a solution, as a velocity."""
        moved = impulses - self._steps * (self.matrix @ impulses + self.free)
        return self._error(impulses - self._project(moved))

    def newton(self, impulses: Vector, most: int) -> tuple[Vector, float]:
        """Return the best impulses of at most `most` steps from given ones, and their error."""
        best, least_error = impulses, math.inf
        for _ in range(most):
            moved = impulses - self._steps * (self.matrix @ impulses + self.free)
            change = self._project(moved)
            change -= impulses
            error = self._error(change)
            if error < least_error:
                best, least_error = impulses, error
                if error < self.accuracy:
                    break
            try:
                impulses = impulses + np.linalg.solve(self._slope(moved), change)
            except np.linalg.LinAlgError:
                break
        return best, least_error

    def _error(self, change: Vector) -> float:
        return float(np.abs(change / self._steps).max())

    def _project(self, moved: Vector) -> Vector:
        """Return impulses, shape (3 k + m,), projected onto cones and bounds."""
        found = moved.copy()
        values = moved[: self._size].tolist()
        for place, friction in zip(range(0, self._size, 3), self._coefficients, strict=True):
            x, y, normal = values[place : place + 3]
            if normal <= 0:
                found[place : place + 3] = 0.0
                continue
            across = math.hypot(x, y)
            if across > friction * normal:
                found[place : place + 2] *= friction * normal / across
        if len(self.least):
            found[self._size :] = np.clip(moved[self._size :], self.least, self.most)
        return found

    def _slope(self, moved: Vector) -> Vector:
        """Return the derivative of impulses minus their projections `_project`, shape (n, n)."""
        slope, unit = self._scaled.copy(), np.eye(len(moved))
        values = moved[: self._size].tolist()
        for place, friction in zip(range(0, self._size, 3), self._coefficients, strict=True):
            x, y, normal = values[place : place + 3]
            rows = slice(place, place + 3)
            if normal <= 0:
                slope[rows] = unit[rows]
                continue
            across = math.hypot(x, y)
            if across > friction * normal:
                x, y, share = x / across, y / across, friction * normal / across
                turn = np.array(
                    [
                        [share * y * y, -share * x * y, friction * x],
                        [-share * x * y, share * x * x, friction * y],
                        [0.0, 0.0, 1.0],
                    ]
                )
                slope[rows] = unit[rows] + turn @ (slope[rows] - unit[rows])
        if len(self.least):
            rest = moved[self._size :]
            fixed = self._size + np.flatnonzero((rest <= self.least) | (rest >= self.most))
            slope[fixed] = unit[fixed]
        return slope
