"""The fit: unknowns from torques, with instruments from a path that the noise does not reach.

Torques are linear in the unknowns, but their columns are made of measured positions, so ordinary
least squares is biased. The instruments are columns along another path: the measured one, corrected
by what the torques say about the encoders' errors, and smoothed. What is left of those errors is
uncorrelated with the residual, so no controller and no commanded motion have to be known.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import qr, solve_triangular

from physx_core.typing import Array, Vector
from physx_identify.errors import IdentificationError
from physx_identify.estimation.base import COORDINATES, Base, Imu
from physx_identify.estimation.model import Model, Path
from physx_identify.estimation.noise import ORDERS, LikelyNoise, Noise, Whitener
from physx_identify.estimation.smooth import Smoother, white_noise
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
_LOWEST = 0.2
"""Share of a nominal value below which the path is not corrected with a value."""
_EDGE = 4
"""Samples left out at both ends, where the smoothed path is uncertain."""
_KINK = 3.0 * np.sqrt(20.0)
"""Third difference of positions with contacts, in deviations of their noise, that is a kink."""
_SEPARABLE = 1e-6
"""Relative length of what is left of a column without the others, below which it is one of them."""
_NEAR = 0.01
"""Share of the encoders' errors in differences that derivatives are made of."""
_FAINT = 1e-9
"""Least noise of positions that counts."""
SLOWEST, _UNSURE = 0.02, 2.0
"""Velocity below which dry friction is unknown: in rad/s or m/s, and in standard errors."""


@dataclass(frozen=True)
class Data:
    """Measured motion and torques.

    Attributes:
        positions: As in `Path`, shape (samples, coordinates).
        torques: Shape (samples, coordinates), in N m or N.
        period: In s.
        instant: As in `Path`.
        slowest: Velocity below which dry friction is unknown, in rad/s or m/s.
        base: What is known of a floating base, whose coordinates come first.
        flight: Whether all that acts on a floating base is known, so that its forces are.
        wrenches: What acts on links, shape (samples, 6), each of the period before a sample.
        axes: Along which axes, as in `Model.acting`.
        contacts: Whether anything else does, shape (samples,), in the period before a sample.
    """

    positions: Vector
    torques: Vector
    period: float
    instant: bool = False
    slowest: float = SLOWEST
    base: Base | Imu | None = None
    flight: bool = False
    wrenches: Mapping[str, Vector] = field(default_factory=dict)
    axes: str = "link"
    contacts: Mapping[str, Array] = field(default_factory=dict)

    @property
    def rows(self) -> slice:
        """Which coordinates have known torques."""
        return slice(0 if self.flight or self.base is None else len(COORDINATES), None)

    def path(self, positions: Vector) -> Path:
        """Return a motion at its times."""
        return Path(positions, self.period, self.instant, self.base)

    def smoother(self, kinks: Array | None = None) -> Smoother:
        """Return what smooths its positions, but not over kinks, shape (samples,)."""
        orders = self.base.orders if isinstance(self.base, Imu) else ()
        return Smoother(self.positions, kinks, orders)

    def of_steps(self, readings: Vector) -> Vector:
        """Return those of readings that belong to the samples of a path."""
        return readings[1:-1] if self.instant else readings[2:]

    def with_readings(self, stencil: Vector, felt: Sequence[Vector]) -> Vector:
        """Return a stencil with derivatives by wrenches, each (samples, joints, 6), at its end."""
        if not felt:
            return stencil
        more = np.zeros((*stencil.shape[:3], 6 * len(felt)))
        more[1 if self.instant else 2] = np.concatenate(felt, axis=2)
        return np.concatenate([stencil, more], axis=3)


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


def fit(
    model: Model,
    parameters: Sequence[Parameter],
    data: Data,
    start: Vector | None = None,
    noise: Noise | None = None,
) -> Fit:
    """Fit parameters.

    Args:
        model: The robot.
        parameters: What is unknown.
        data: The log.
        start: Values to start at; None: those of least squares along the smoothed path.
        noise: Noise of the log to start with; None: found from the first residual.
    """
    return Problem(model, parameters, data).solve(start, noise)


@dataclass(frozen=True)
class _Equation:
    """Torques that are linear in parameters: target = columns @ values + residual.

    Attributes:
        instruments: Columns along a path that the noise does not reach, shape (samples, joints,
            parameters).
        columns: Columns of what was measured, of the same shape.
        target: Shape (samples, joints).
        stencil: As in `Model.stencil`, along the same path as the instruments, by positions and
            wrenches in deviations of the encoders, shape (3, samples, joints, readings).
        torques: Of the model along that path, of the same shape as the target.
        doubt: By what dry friction differs if it is applied another way, shape (samples, joints).
    """

    instruments: Vector
    columns: Vector
    target: Vector
    stencil: Vector
    torques: Vector
    doubt: Vector


class Problem:
    """Parameters of a robot in a log.

    Args:
        model: The robot.
        parameters: What is unknown.
        data: The log.
    """

    def __init__(self, model: Model, parameters: Sequence[Parameter], data: Data) -> None:
        self._model, self._parameters, self._data = model, parameters, data
        self._nominal = np.array([each.nominal for each in parameters])
        self._directions = np.stack([model.direction(each) for each in parameters], axis=1)
        self._known = model.numbers - self._directions @ self._nominal
        self._lowest = np.array([
            -np.inf if each.lowest is None else _LOWEST * each.nominal for each in parameters
        ])  # fmt: skip
        self._special = [
            (place, each) for place, each in enumerate(parameters)
            if each.kind in ("gain", "bias", "encoder", "delay")
        ]  # fmt: skip
        self._plain = [each.kind not in ("gain", "delay", "encoder") for each in parameters]
        self._rows, self._scale = data.rows, _noises(data)
        delayed = any(each.kind == "delay" for _, each in self._special)
        self._smooth = Smoother(data.torques) if delayed else None
        joints = model.coordinates
        dry = np.zeros(len(joints), bool)
        rubbing = model.numbers[11 * len(joints) : 13 * len(joints)].reshape(2, -1)
        dry |= rubbing.any(axis=0)
        for each in parameters:
            if each.kind in ("friction", "stribeck"):
                dry[joints.index(each.of)] = True
        self._dry = dry
        self._kinks, self._struck = self._contacts()

    def _contacts(self) -> tuple[Array | None, Array]:
        """Return where velocities may jump, and which torques contacts enter, by coordinates."""
        data, model = self._data, self._model
        struck = np.zeros((len(data.positions), len(model.coordinates)), bool)
        for link, on in data.contacts.items():
            struck |= on[:, None] & model.moved(link)
        if not data.wrenches and not data.contacts:
            return None, struck[1:-1]
        kinks = _around(
            np.any(struck, axis=1), 2, 1
        )  # the step before a flag, and the samples around
        noise = white_noise(data.positions)
        kinks[2:-1] |= (np.abs(np.diff(data.positions, 3, axis=0)) > _KINK * noise).any(axis=1)
        kinks[:-1] |= kinks[1:]
        return kinks, _around(struck, _EDGE + 1, _EDGE)[1:-1]

    def _positions(self, values: Vector) -> Vector:
        """Return measured positions without the encoders' offsets."""
        found = self._data.positions
        for place, each in self._special:
            if each.kind == "encoder":
                offset = values[place] * (np.array(self._model.coordinates) == each.of)
                found = found - offset
        return found

    def _late(self, values: Vector) -> float:
        """Return by how many samples the torques are late."""
        delays = (values[place] for place, each in self._special if each.kind == "delay")
        return float(sum(delays)) / self._data.period

    def _torques(self, values: Vector, whole: int) -> Vector:
        """Return measured torques at the times of the positions, shape (samples - 2, joints).

        They are moved by whole samples, or their noise would be smoothed, too; without it, what is
        left of the delay moves them.
        """
        torques = self._data.torques
        time = np.arange(len(torques))
        rows = np.clip(time[1:-1] + whole, 0, time[-1])
        rest = self._late(values) - whole
        if not rest or self._smooth is None:
            return torques[rows]
        smooth = self._smooth(torques)
        late: Vector = torques[rows] + CubicSpline(time, smooth)(rows + rest) - smooth[rows]
        return late

    def _slopes(self, torques: Vector) -> Vector:
        """Return how torques change with a delay, without noise, shape (samples - 2, joints)."""
        assert self._smooth is not None
        found = np.gradient(self._smooth(np.pad(torques, ((1, 1), (0, 0)), mode="edge")), axis=0)
        slopes: Vector = -found[1:-1] / self._data.period
        return slopes

    def _equation(self, path: Path, raw: Path, values: Vector, whole: int) -> _Equation:
        """Return what is linear in the parameters, near values of them.

        Args:
            path: That of the instruments.
            raw: As measured.
            values: Values of the parameters.
            whole: Whole samples of the delay.
        """
        numbers = self._known + self._directions @ np.maximum(values, self._lowest)
        stencil = self._model.stencil(path, numbers)
        dry, doubt, acting = None, np.zeros(path.own.shape), np.zeros((2, *path.own.shape))
        if (self._dry.any() or self._data.wrenches) and not path.instant:
            # halfway between the two ways of engines
            dry = 0.5 * (self._model.dry(path, stencil, numbers) + np.eye(path.own.shape[1]))
        felt = []
        for link, wrenches in self._data.wrenches.items():
            readings = self._data.of_steps(wrenches)
            by_reading, slopes = self._model.wrenches(path, link, readings, self._data.axes)
            acting += np.einsum("kij,kj->ki", by_reading, readings)
            acting[1] += np.einsum("kij,kj->ki", slopes, raw.own - path.own)
            stencil[1] -= slopes
            felt.append(-by_reading)
        if dry is not None:
            impulses = self._model.friction(path, numbers) - acting[0]
            doubt = np.einsum("kij,kj->ki", dry, impulses) - impulses
            acting = np.einsum("kij,akj->aki", dry, acting)
            felt = [dry @ each for each in felt]
        torques = self._torques(values, whole)
        instruments, known = self._columns(path, path, stencil, dry, torques)
        known -= acting[0]
        own = known + instruments[..., self._plain] @ values[self._plain]
        instruments = self._endogenous(instruments, own)
        columns, known = self._columns(path, raw, stencil, dry, torques)
        target = torques - known + acting[1]
        for place, each in self._special:
            if each.kind == "gain":
                target = target + columns[..., place]
            elif each.kind in ("delay", "encoder"):
                if each.kind == "encoder":
                    columns[..., place] = instruments[..., place]
                target = target + columns[..., place] * values[place]
        rows = self._rows
        return _Equation(
            instruments[:, rows],
            columns[:, rows],
            target[:, rows],
            self._scale * self._data.with_readings(stencil, felt)[:, :, rows],
            own[:, rows],
            doubt[:, rows],
        )

    def _columns(
        self, path: Path, raw: Path, stencil: Vector, dry: Vector | None, torques: Vector
    ) -> tuple[Vector, Vector]:
        """Return columns along a motion near a path, to first order in what it differs by.

        Returns:
            Shape (samples, joints, parameters); and what is known beside them.
        """
        given = np.column_stack([self._directions, self._known])
        found = self._model.columns(path, given, path.ends, dry)
        if raw is not path:
            change = _NEAR * (raw.positions - path.positions)
            for sign in (1, -1):
                near = dataclasses.replace(path, positions=path.positions + sign * change)
                found += sign / (2 * _NEAR) * self._model.columns(near, given, path.ends, dry)
        columns, known = found[..., :-1], found[..., -1]
        for place, each in self._special:
            if each.kind == "delay":
                columns[..., place] = self._slopes(torques)
                continue
            joint = self._model.coordinates.index(each.of)
            if each.kind == "encoder":
                columns[..., place] = -stencil.sum(axis=0)[:, :, joint]
            else:
                columns[:, joint, place] = -torques[:, joint] if each.kind == "gain" else 1.0
        return columns, known

    def solve(self, start: Vector | None, noise: Noise | None) -> Fit:
        """Repeat: noise of the residual, values, path."""
        values = self._nominal if start is None else start
        smoother, fixed = self._data.smoother(self._kinks), noise is not None
        corrections: Vector | float = 0.0
        whole, settled = 0, False
        slow = np.full(len(self._model.coordinates), self._data.slowest)
        found: Fit | None = None
        likely: LikelyNoise | None = None
        for step in range(1, _STEPS + 1):
            measured = self._positions(values)
            raw = self._data.path(measured)
            moving = step <= _PATH_STEPS or (not settled and step <= _LONGEST)
            if moving:  # then it stays, or the sign of slow motions may never settle
                path = dataclasses.replace(raw, positions=smoother(measured + corrections))
                used = ~(self._dry & _unsure(path.ends, slow))[:, self._rows]
                whole = round(self._late(values))
                used &= ~self._struck[:, self._rows]
                used[: max(_EDGE, -whole)] = used[-max(_EDGE, whole) :] = False
            equation = self._equation(path, raw, values, whole)
            if start is None and step == 1:
                values = self._first(path, smoother, used)
            whitener = Whitener(equation.stencil, used)
            residual = equation.target - equation.columns @ values
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
            corrections = self._scaled(whitener.corrections(found.residual, noise))
            if self._dry.any() and moving:
                errors, left = whitener.draw(noise)
                errors = self._scaled(errors + whitener.corrections(left, noise))
                unsure = np.diff(smoother(errors), axis=0)
                slow = np.maximum(
                    self._data.slowest, _UNSURE * unsure.std(axis=0) / self._data.period
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

    def _scaled(self, errors: Vector) -> Vector:
        """Return errors of the positions, from those of all readings in deviations."""
        found: Vector = (self._scale * errors)[:, : len(self._model.coordinates)]
        return found

    def distance(self, found: Fit, place: int, value: float) -> float:
        """Return half the squared distance of the torques if one parameter had another value.

        It is that of the part that instruments explain, whitened by the fit's noise; the other
        fitted parameters are what makes it least.

        Args:
            found: The fit.
            place: Place of the parameter, an independent one.
            value: Its value.
        """
        others = found.independent != place
        row, free = int(np.argmin(others)), found.independent[others]
        values, prior = found.values.copy(), self._priors()
        near = found.covariance[:, row] / found.covariance[row, row]
        values[found.independent] += near * (value - found.values[place])
        moved = self._positions(values) - self._positions(found.values)
        path = dataclasses.replace(found.path, positions=found.path.positions + moved)
        raw = dataclasses.replace(path, positions=self._positions(values))
        whole = round(self._late(found.values))
        for _ in range(_AROUND):
            equation = self._equation(path, raw, values, whole)
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
        prior, mean = self._priors()
        return np.column_stack([prior[:, fitted], mean - prior @ values])

    def _endogenous(self, columns: Vector, own: Vector) -> Vector:
        """Return columns whose torques are the model's own instead of measured ones."""
        found = columns.copy()
        for place, each in self._special:
            if each.kind == "delay":
                found[..., place] = self._slopes(own)
            elif each.kind == "gain":
                joint = self._model.coordinates.index(each.of)
                found[:, joint, place] = -own[:, joint]
        return found

    def _first(self, path: Path, smoother: Smoother, used: Array) -> Vector:
        """Return the values of least squares along a smoothed path, for torques smoothed alike."""
        smooth = dataclasses.replace(self._data, torques=smoother(self._data.torques))
        equation = Problem(self._model, self._parameters, smooth)._equation(
            path, path, self._nominal, 0
        )
        target, flat = equation.target, equation.columns[used]
        weights = 1 / np.sqrt(np.mean(np.where(used, target, 0.0) ** 2, axis=0) + 1e-12)
        weights = np.broadcast_to(weights, used.shape)[used]
        rows, goal = flat * weights[:, None], target[used] * weights
        prior, mean = self._priors()
        rows, goal = np.concatenate([rows, prior]), np.concatenate([goal, mean])
        scale = np.linalg.norm(rows, axis=0)
        scale[scale == 0] = 1.0
        change = np.linalg.lstsq(rows / scale, goal - rows @ self._nominal, rcond=1e-6)[0]
        found: Vector = self._nominal + change / scale
        return found

    def _priors(self) -> tuple[Vector, Vector]:
        given = [(n, each) for n, each in enumerate(self._parameters) if each.deviation is not None]
        rows, mean = np.zeros((len(given), len(self._parameters))), np.zeros(len(given))
        for row, (place, each) in enumerate(given):
            assert each.deviation is not None
            rows[row, place], mean[row] = 1 / each.deviation, each.mean / each.deviation
        return rows, mean

    def _step(
        self,
        whitener: Whitener,
        equation: _Equation,
        before: Vector,
        noise: Noise,
        step: int,
        path: Path,
        used: Array,
    ) -> Fit:
        target, columns = equation.target, equation.columns
        z, a, y = _whitened(whitener, equation, noise, *self._priors())
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
        values = self._nominal.copy()
        values[free] = before[free] + mixing @ (before[held] - values[held])
        # As in Fisher's scoring: unlike z.T @ a, this is positive definite whatever the noise.
        square = z[:, free].T @ z[:, free]
        values[free] += np.linalg.solve(square, z[:, free].T @ (y - a @ values))
        inner = np.linalg.inv(z[:, free].T @ a[:, free])
        covariance = inner @ square @ inner.T
        sort = np.argsort(free)
        own = equation.instruments[..., self._plain] @ (values - before)[self._plain]
        return Fit(
            values, free[sort], held, mixing[sort], covariance[np.ix_(sort, sort)], noise, step,
            False, y - a @ values, z, a, equation.torques + own,
            target - columns @ values, equation.instruments[..., free[sort]], used, path, whitener,
            np.full(rank, float(used.sum() - rank)), self._known_of(free[sort], values),
        )  # fmt: skip


def _noises(data: Data) -> Vector:
    """Return the noise of each position, and each wrench, relative to the encoders'."""
    noise = white_noise(data.positions)
    base = 0 if data.base is None else len(COORDINATES)
    encoder = max(_size(noise[base:]), _FAINT)
    scale = np.ones(len(noise))
    for part in (slice(0, base // 2), slice(base // 2, base)):
        if data.base is not None:
            scale[part] = max(_size(noise[part]), _FAINT) / encoder
    felt = [white_noise(each) / encoder for each in data.wrenches.values()]
    return np.concatenate([scale, *felt])


def _size(values: Vector) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _whitened(
    whitener: Whitener, equation: _Equation, noise: Noise, prior: Vector, mean: Vector
) -> tuple[Vector, Vector, Vector]:
    """Return whitened instruments, columns and target, with what is known beforehand as rows."""
    factor = whitener.factor(noise)
    z, a = (
        np.concatenate([whitener.whitened(each, noise, factor), prior])
        for each in (equation.instruments, equation.columns)
    )
    return z, a, np.concatenate([whitener.whitened(equation.target, noise, factor), mean])


def _unsure(velocities: Vector, slow: Vector) -> Array:
    """Return where the sign of velocities, shape (samples, joints), is unsure.

    That is where they are slow, and next to a reversal, where dry friction may have stopped a joint
    for a moment, and smoothing takes most from the path.
    """
    found: Array = np.abs(velocities) < slow
    turned = np.diff(np.sign(velocities), axis=0) != 0
    found[1:] |= turned
    found[:-1] |= turned
    return found


def _around(on: Array, before: int, after: int) -> Array:
    """Return where something is on, with so many samples before and after."""
    found = on.copy()
    for _ in range(before):
        found[:-1] |= found[1:]
    for _ in range(after):
        found[1:] |= found[:-1]
    return found
