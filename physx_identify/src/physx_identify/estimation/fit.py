"""The fit: unknowns from torques, with instruments from a path that the noise does not reach.

Torques are linear in the unknowns, but their columns are made of measured positions, so ordinary
least squares is biased. The instruments are columns along another path: the measured one, corrected
by what the torques say about the encoders' errors, and smoothed. What is left of those errors is
uncorrelated with the residual, so no controller and no commanded motion have to be known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr, solve_triangular

from physx_core.typing import Array, Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.equations import Data, Equation, Equations
from physx_identify.estimation.model import Model, Path
from physx_identify.estimation.noise import ORDERS, LikelyNoise, Noise, Whitener
from physx_identify.estimation.smooth import Smoother
from physx_identify.estimation.uncertainty import values_of
from physx_identify.unknowns import Parameter

_STEPS = 30
_WHITE_STEPS, _NOISE_STEPS, _PATH_STEPS, _LONGEST = 2, 5, 7, 16
"""Steps that take the noise of torques as white; that look at it, the last by its exact likelihood;
that correct the path at least, and at most. What wrong values leave looks like correlated noise, so
that comes second."""
_SETTLED = 1.0
"""Change of a value between two steps, in standard errors, below which the path needs no more."""
_AROUND = 2
"""Steps of the other parameters around a value that one is given."""
_CLOSE = 0.1
"""Change of a value between two steps, in standard errors, that ends them."""
_EDGE = 4
"""Samples left out at both ends, where the smoothed path is uncertain."""
_SEPARABLE = 1e-6
"""Relative length of what is left of a column without the others, below which it is one of them."""
_UNSURE, _STOPPING = 2.0, 2.0
"""Where dry friction is unknown: velocity in standard errors; steps before a joint stops, in which
engines may let it fade."""


@dataclass(frozen=True)
class Fit:
    """What a fit found.

    Attributes:
        values: Of all parameters; those that cannot be told apart stay as they were.
        independent: Places of the parameters that were fitted, the others held.
        dependent: Places of the held ones.
        mixing: What a unit of each held parameter adds to the fitted ones, shape (independent,
            dependent).
        covariance: Of the fitted values, shape (independent, independent).
        noise: The log's noise.
        steps: Number of steps.
        converged: Whether the last step was smaller than a tenth of the standard errors.
        white: Whitened residual, shape (rows,).
        instruments: Whitened columns along the other path, shape (rows, parameters).
        columns: Whitened columns of what was measured, shape (rows, parameters).
        torques: Torques of the model along the other path, shape (samples - 2, joints), with biases
            of logged torques, as these have them.
        residual: Of the torques, shape (samples - 2, joints), in N m or N.
        regressors: Columns of the fitted values along the other path, shape (samples - 2, joints,
            independent).
        used: Which torques count, shape (samples - 2, joints).
        path: The path of the instruments.
        whitener: What whitens.
        freedom: Degrees of freedom of the fitted values' errors, shape (independent,).
        known: What is known of the fitted values beforehand, and is left of it, one a row, shape
            (priors, independent + 1).
        likely: The noise, and how uncertain it is; None: it was given.
    """

    values: Vector
    independent: Array
    dependent: Array
    mixing: Vector
    covariance: Vector
    noise: Noise
    steps: int
    converged: bool
    white: Vector
    instruments: Vector
    columns: Vector
    torques: Vector
    residual: Vector
    regressors: Vector
    used: Array
    path: Path
    whitener: Whitener
    freedom: Vector
    known: Vector
    likely: LikelyNoise | None = None


class Problem:
    """Parameters of a robot in a log.

    Args:
        model: The robot.
        parameters: What is unknown.
        data: The log.
    """

    def __init__(self, model: Model, parameters: Sequence[Parameter], data: Data) -> None:
        self.parameters = parameters
        self._equations = Equations(model, parameters, data)

    def solve(self, start: Vector | None = None, noise: Noise | None = None) -> Fit:
        """Repeat: noise of the residual, values, path.

        Args:
            start: Values to start at; None: those of least squares along the smoothed path.
            noise: Noise of the log; None: that of the residual.
        """
        equations = self._equations
        values = equations.nominal if start is None else start
        smoother, fixed = equations.smoother, noise is not None
        corrections: Vector | float = 0.0
        whole, settled = 0, False
        slow = np.full(len(equations.model.coordinates), equations.data.slowest)
        found: Fit | None = None
        likely: LikelyNoise | None = None
        for step in range(1, _STEPS + 1):
            measured = equations.positions(values)
            raw = equations.data.path(measured)
            moving = step <= _PATH_STEPS or (not settled and step <= _LONGEST)
            if moving:  # then it stays, or the sign of slow motions may never settle
                path = dataclasses.replace(raw, positions=smoother(measured + corrections))
                used = ~(equations.dry & _unsure(path, slow))[:, equations.data.rows]
                used &= ~equations.struck[:, equations.data.rows]
                whole = round(equations.late(values))
                used[: max(_EDGE, -whole)] = used[-max(_EDGE, whole) :] = False
            equation = equations.at(path, raw, values, whole)
            if start is None and step == 1:
                values = self._first(path, smoother, used)
            whitener = Whitener(equation.stencil, used)
            residual = equations.bridged(equation.target - equation.columns @ values)
            if not fixed:
                if step == _NOISE_STEPS or (moving and step >= _PATH_STEPS):
                    assert noise is not None
                    assert found is not None
                    free = equation.instruments[..., found.independent]
                    likely = whitener.fit(residual, noise, free, found.known)
                    noise = likely.noise
                elif step < _NOISE_STEPS:
                    noise = whitener.guess(residual, ORDERS if step > _WHITE_STEPS else 0)
            assert noise is not None
            found = self._step(whitener, equation, values, noise, step, path, used)
            moved = np.abs(found.values - values)[found.independent]
            moved /= np.sqrt(np.diag(found.covariance))
            values, settled = found.values, bool((moved < _SETTLED).all())
            if not moving and (moved < _CLOSE).all():
                found = dataclasses.replace(found, converged=True)
                break
            corrections = equations.scaled(whitener.corrections(found.residual, noise))
            if equations.dry.any() and moving:
                errors, left = whitener.draw(noise)
                errors = equations.scaled(errors + whitener.corrections(left, noise))
                unsure = np.diff(smoother(errors), axis=0)
                slow = np.maximum(
                    equations.data.slowest, _UNSURE * unsure.std(axis=0) / equations.data.period
                )
        assert found is not None
        if likely is None:
            return found
        known = np.column_stack([found.known[:, :-1], np.zeros(len(found.known))])
        sure, other = (
            values_of(whitener, likely, each, found.regressors, prior)[0]
            for each, prior in ((found.residual, found.known), (equation.doubt, known))
        )
        covariance = sure.covariance + np.outer(other.values, other.values)
        return dataclasses.replace(
            found, covariance=covariance, freedom=sure.freedom, likely=likely
        )

    def distance(self, found: Fit, place: int, value: float) -> float:
        """Return half the squared distance of the torques if one parameter had another value.

        It is that of the part that instruments explain, whitened by the fit's noise; the other
        fitted parameters are what makes it least.

        Args:
            found: The fit.
            place: Place of the parameter, an independent one.
            value: Its value.
        """
        equations, others = self._equations, found.independent != place
        row, free = int(np.argmin(others)), found.independent[others]
        values, prior = found.values.copy(), equations.priors()
        near = found.covariance[:, row] / found.covariance[row, row]
        values[found.independent] += near * (value - found.values[place])
        moved = equations.positions(values) - equations.positions(found.values)
        path = dataclasses.replace(found.path, positions=found.path.positions + moved)
        raw = dataclasses.replace(path, positions=equations.positions(values))
        whole = round(equations.late(found.values))
        for _ in range(_AROUND):
            equation = equations.at(path, raw, values, whole)
            whitener = Whitener(equation.stencil, found.used)
            z, a, y = _whitened(whitener, equation, found.noise, *prior)
            basis = np.linalg.qr(z[:, found.independent])[0]
            left = basis.T @ (y - a @ values)
            slopes = basis.T @ a[:, free]
            step = np.linalg.lstsq(slopes, left, rcond=None)[0] if len(free) else np.zeros(0)
            values[free] += step
        return 0.5 * float(np.sum((left - slopes @ step) ** 2))

    def _known_of(self, fitted: Array, values: Vector) -> Vector:
        """Return what is known beforehand as rows: of the fitted values, and what is left."""
        prior, mean = self._equations.priors()
        return np.column_stack([prior[:, fitted], mean - prior @ values])

    def _first(self, path: Path, smoother: Smoother, used: Array) -> Vector:
        """Return the values of least squares along a smoothed path, for torques smoothed alike."""
        equations = self._equations
        smooth = dataclasses.replace(equations.data, torques=smoother(equations.data.torques))
        smoothed = Equations(equations.model, equations.parameters, smooth)
        equation = smoothed.at(path, path, equations.nominal, 0)
        target, flat = equation.target, equation.columns[used]
        weights = 1 / np.sqrt(np.mean(np.where(used, target, 0.0) ** 2, axis=0) + 1e-12)
        weights = np.broadcast_to(weights, used.shape)[used]
        rows, goal = flat * weights[:, None], target[used] * weights
        prior, mean = equations.priors()
        rows, goal = np.concatenate([rows, prior]), np.concatenate([goal, mean])
        scale = np.linalg.norm(rows, axis=0)
        scale[scale == 0] = 1.0
        change = np.linalg.lstsq(rows / scale, goal - rows @ equations.nominal, rcond=1e-6)[0]
        found: Vector = equations.nominal + change / scale
        return found

    def _step(
        self,
        whitener: Whitener,
        equation: Equation,
        before: Vector,
        noise: Noise,
        step: int,
        path: Path,
        used: Array,
    ) -> Fit:
        equations, target, columns = self._equations, equation.target, equation.columns
        z, a, y = _whitened(whitener, equation, noise, *equations.priors())
        scale = np.linalg.norm(z, axis=0)
        scale[scale == 0] = 1.0
        _, triangle, order = qr(z / scale, mode="economic", pivoting=True)
        sizes = np.abs(np.diag(triangle))
        rank = int((sizes > _SEPARABLE * sizes[:1]).sum()) if sizes[:1].any() else 0
        if not rank:
            raise IdentificationError(
                "Nothing unknown acts on the torques of this log. Move the joints concerned."
            )
        free, held = order[:rank], order[rank:]
        mixing = solve_triangular(triangle[:rank, :rank], triangle[:rank, rank:])
        mixing *= scale[held] / scale[free][:, None]
        values = equations.nominal.copy()
        values[free] = before[free] + mixing @ (before[held] - values[held])
        # As in Fisher's scoring: unlike z.T @ a, this is positive definite whatever the noise.
        square = z[:, free].T @ z[:, free]
        values[free] += np.linalg.solve(square, z[:, free].T @ (y - a @ values))
        inner = np.linalg.inv(z[:, free].T @ a[:, free])
        covariance = inner @ square @ inner.T
        sort = np.argsort(free)
        own = equation.instruments[..., equations.plain] @ (values - before)[equations.plain]
        return Fit(
            values, free[sort], held, mixing[sort], covariance[np.ix_(sort, sort)], noise, step,
            False, y - a @ values, z, a, equation.torques + own,
            equations.bridged(target - columns @ values), equation.instruments[..., free[sort]],
            used, path, whitener,
            np.full(rank, float(used.sum() - rank)), self._known_of(free[sort], values),
        )  # fmt: skip


def _whitened(
    whitener: Whitener, equation: Equation, noise: Noise, prior: Vector, mean: Vector
) -> tuple[Vector, Vector, Vector]:
    """Return whitened instruments, columns and target, with what is known beforehand as rows."""
    factor = whitener.factor(noise)
    z, a = (
        np.concatenate([whitener.whitened(each, noise, factor), prior])
        for each in (equation.instruments, equation.columns)
    )
    return z, a, np.concatenate([whitener.whitened(equation.target, noise, factor), mean])


def _unsure(path: Path, slow: Vector) -> Array:
    """Return where the sign of velocities is unsure, shape (samples, joints).

    That is where they are slow or about to stop, and next to a reversal, where dry friction may
    have stopped a joint for a moment, and smoothing takes most from the path.
    """
    velocities, lost = path.ends, -_STOPPING * path.period * path.accelerations
    found: Array = np.abs(velocities) < np.maximum(slow, lost * np.sign(velocities))
    turned = np.diff(np.sign(velocities), axis=0) != 0
    found[1:] |= turned
    found[:-1] |= turned
    return found
