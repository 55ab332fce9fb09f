"""Newton's method for impulses of points with friction cones and rows with bounds."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import eigenpy
import numpy as np

from physx_core.typing import Index, Vector
from physx_sim.errors import SimulationError

_REGULARIZATION = 1e-9
"""Relative regularization of the diagonal, as in DART's solver."""
_STUCK = 1e-14
"""Response, relative to the largest, below which a direction counts as immobile."""
_ACCURACY = 1e-9
"""Accuracy of velocities, in m/s, for free velocities of 1 m/s or less."""
_Turned = tuple[slice, slice | list[int], Sequence[Sequence[float]]]
"""Rows that a projection changes, the rows on which the result depends, and how."""


class ContactProblem:
    """The problem of finding the impulses that prevent penetration and keep rows in their bounds.

    A point's impulse lies in its friction cone and opposes sliding (Coulomb's law); a row's impulse
    lies within its bounds, and a row at neither bound has velocity 0. Points that resist turning
    have two more such laws, for their angular impulses across and about the normal. Such impulses
    are fixed points of a step against the velocities followed by a projection onto the cones and
    bounds. This equation is piecewise smooth: Newton's method solves it exactly once it has
    determined which points stick, slide, or separate (P. Alart and A. Curnier, A mixed formulation
    for frictional contact problems prone to Newton like solution methods, Computer Methods in
    Applied Mechanics and Engineering 92, 1991).

    Attributes:
        matrix: Velocities for unit impulses, shape (n, n): n is 3 k + m, or 3 k + m + 3 s.
        free: Velocities without impulses minus the target ones, shape (n,): of k points along two
            tangents and the normal, of m rows, then of s points about these axes.
        friction: Coefficients of the points, shape (k,).
        least: Smallest impulses of the rows, shape (m,).
        most: Largest impulses of the rows, shape (m,).
        accuracy: Error up to which impulses count as exact.
    """

    def __init__(
        self,
        response: Vector,
        free: Vector,
        friction: Vector,
        least: Vector,
        most: Vector,
        turning: tuple[Index, Vector] | None = None,
    ) -> None:
        """Set up the problem, with a diagonal that is slightly larger than that of `response`.

        A direction in which nothing can move, such as across a rail, gets no impulse, because any
        impulse would do.

        Args:
            response: The matrix before that.
            free: As in the attribute.
            friction: Likewise.
            least: Likewise.
            most: Likewise.
            turning: Points that resist turning, as indices, and their largest angular impulses per
                normal impulse across and about the normal, in m, shape (s, 2).

        Raises:
            SimulationError: If a value is not finite.
        """
        self.matrix = regularized(response)
        # Lists, because operations on short arrays take longer.
        rates, speeds = self.matrix.diagonal().tolist(), free.tolist()
        # A non-finite entry of the response makes the diagonal non-finite, too.
        if not math.isfinite(sum(speeds) + sum(rates)):
            raise SimulationError("The state is no longer finite. Use a smaller period.")
        largest = max(rates) or 1.0
        if min(rates) <= (least_rate := _STUCK * largest):
            free = np.where(np.array(rates) <= least_rate, 0.0, free)
            speeds = free.tolist()
            rates = [largest if rate <= least_rate else rate for rate in rates]
            self.matrix.flat[:: len(free) + 1] = rates
        self.free = free
        self.friction, self.least, self.most = friction, least, most
        self._coefficients = friction.tolist()
        for place in range(0, 3 * len(self._coefficients), 3):
            rates[place : place + 3] = [max(rates[place : place + 3])] * 3
        self._turning: list[tuple[int, float, float]] = []
        if turning is not None:
            points, bounds = turning
            self._turning = list(zip((3 * points + 2).tolist(), *bounds.T.tolist(), strict=True))
            for place in range(len(free) - self.turning_rows, len(free), 3):
                rates[place : place + 2] = [max(rates[place : place + 2])] * 2
        self._rates = np.array(rates)
        # A step against the velocities, scaled per row.
        self._unit, self._scaled = unit(len(free)), self.matrix / self._rates[:, None]
        self._back, self._start = self._unit - self._scaled, free / self._rates
        self._bounds = list(zip(least.tolist(), most.tolist(), strict=True))
        self.accuracy = _ACCURACY * max(1.0, max(speeds), -min(speeds))

    @property
    def turning_rows(self) -> int:
        """Number of rows of the points that resist turning."""
        return 3 * len(self._turning)

    def error(self, impulses: Vector) -> float:
        """Return the distance of impulses from a solution, as a velocity."""
        return self._error(self._project(impulses)[0] - impulses)

    def newton(self, impulses: Vector, most: int) -> tuple[Vector, float]:
        """Return the best impulses within `most` steps from given ones, and their error."""
        best, least_error = impulses, math.inf
        for _ in range(most):
            projected, held, turned = self._project(impulses)
            change = projected - impulses
            error = self._error(change)
            if error < least_error:
                best, least_error = projected, error
                if error < self.accuracy:
                    break
            elif not error < math.inf:
                break
            slope = self._slope(held, turned, self._scaled, self._back)
            impulses = impulses + eigenpy.PartialPivLU(slope).solve(change)
        return best, least_error

    def slope(self, impulses: Vector) -> Vector:
        """Return the derivative of the solution by the free velocities, shape (n, n).

        At a switch, as between sticking and sliding, it is that of one side.

        Args:
            impulses: The solution.
        """
        _, held, turned = self._project(impulses)
        slope = self._slope(held, turned, self._scaled, self._back)
        # The projection alone, as if impulses had no response.
        rest = self._slope(held, turned, np.zeros(slope.shape), self._unit)
        found: Vector = eigenpy.PartialPivLU(slope).solve((rest - self._unit) / self._rates)
        return found

    def _error(self, change: Vector) -> float:
        velocities = change * self._rates
        return math.sqrt(velocities.dot(velocities))

    def _project(self, impulses: Vector) -> tuple[Vector, list[int], list[_Turned]]:
        """Return impulses (n,) after a step and a projection onto the cones and bounds.

        Also return the rows that the projection made constant, and where it turned others.
        """
        values = (self._back.dot(impulses) - self._start).tolist()
        place = 0
        held: list[int] = []
        turned: list[_Turned] = []
        for friction in self._coefficients:
            x, y, normal = values[place : place + 3]
            if normal <= 0:
                values[place : place + 3] = 0.0, 0.0, 0.0
                held += (place, place + 1, place + 2)
            elif (across := math.hypot(x, y)) > (bound := friction * normal):
                share, x, y = bound / across, x / across, y / across
                values[place], values[place + 1] = bound * x, bound * y
                turn = (
                    (share * y * y, -share * x * y, friction * x),
                    (-share * x * y, share * x * x, friction * y),
                )
                turned.append((slice(place, place + 2), slice(place, place + 3), turn))
            place += 3
        for least, most in self._bounds:
            if not least < values[place] < most:
                values[place] = least if values[place] <= least else most
                held.append(place)
            place += 1
        for normal, across, about in self._turning:
            turned += _limit_turning(values, held, place, normal, (across, about))
            place += 3
        return np.array(values), held, turned

    def _slope(
        self, held: Sequence[int], turned: Sequence[_Turned], scaled: Vector, back: Vector
    ) -> Vector:
        """Return the derivative of impulses minus their projection, shape (n, n).

        Args:
            held: Rows that the projection made constant.
            turned: Where it turned others.
            scaled: The derivative of the impulses minus those after the step, shape (n, n).
            back: The derivative of the impulses after the step, in the same form.
        """
        slope, unit = scaled.copy(), self._unit
        for row in held:
            slope[row] = unit[row]
        for rows, sources, turn in turned:
            slope[rows] = unit[rows] - np.array(turn).dot(back[sources])
        return slope


def _limit_turning(
    values: list[float], held: list[int], place: int, normal: int, bounds: Sequence[float]
) -> list[_Turned]:
    """Project the angular impulses of a point, from a row on, given its normal's row.

    Return where that turned them; add those that it made constant to `held`.
    """
    across, about = (bound * values[normal] for bound in bounds)
    turned: list[_Turned] = []
    x, y, z = values[place : place + 3]
    if not across:
        values[place : place + 2] = 0.0, 0.0
        held += (place, place + 1)
    elif (size := math.hypot(x, y)) > across:
        share, x, y = across / size, x / size, y / size
        values[place], values[place + 1] = across * x, across * y
        turn = (
            (share * y * y, -share * x * y, bounds[0] * x),
            (-share * x * y, share * x * x, bounds[0] * y),
        )
        turned.append((slice(place, place + 2), [place, place + 1, normal], turn))
    if abs(z) >= about:
        values[place + 2] = math.copysign(about, z)
        if about:
            slope = ((math.copysign(bounds[1], z),),)
            turned.append((slice(place + 2, place + 3), [normal], slope))
        else:
            held.append(place + 2)
    return turned


def regularized(response: Vector) -> Vector:
    """Return a matrix with a slightly larger diagonal."""
    return response * _factors(len(response))


@functools.lru_cache(maxsize=100)
def _factors(n: int) -> Vector:
    return 1.0 + _REGULARIZATION * np.eye(n)


@functools.lru_cache(maxsize=100)
def unit(n: int) -> Vector:
    """Return the identity matrix, which must not be modified."""
    return np.eye(n)
