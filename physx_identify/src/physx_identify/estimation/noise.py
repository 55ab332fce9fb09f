"""Noise of a log: of the torques, autoregressive, and of the encoders, white.

The residual of the torques is ``e - B n``: ``e`` are errors of the torques, which for a commanded
torque are disturbances, and ``n`` those of the encoders, which ``B``, the derivative of the torques
by the positions of three neighboring samples, turns into torques. Filtered by the autoregression,
their covariance is a band: it is built, factorized and inverted exactly.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded, lapack, toeplitz
from scipy.optimize import minimize
from scipy.signal import lfilter

from physx_core.typing import Array, Vector

ORDERS = 2
"""Highest order of the autoregression of torques."""
_ITERATIONS = 4
_NEVER = 1e12
_ANYTHING = 100.0
"""Deviation of what a torque that does not count may be, in deviations of its noise."""
_NEAR = 1e-6
_APART = 0.5
"""Distance along an axis, in standard deviations, at which likelihoods are compared."""
_FLATTEST, _FARTHEST, _NOWHERE = 0.05, 2.0, 0.1
"""Least curvature along an axis; longest and shortest step, in standard deviations."""
_NEAR_ENOUGH = 0.3
"""Distance from the most likely noise, in its own standard deviations, that ends the search."""
_USUAL = 0.75
"""Usual inverse hyperbolic tangent of an autocorrelation: between 0 and 0.94."""


@dataclass(frozen=True)
class Noise:
    """Deviations and correlations of a log's noise.

    Attributes:
        encoder: Standard deviation of the positions, in rad or m.
        torque: Standard deviation of the innovations of each torque, shape (joints,), in N m or N.
        regression: Coefficients of the autoregression of each torque, shape (joints, order).
    """

    encoder: float
    torque: Vector
    regression: Vector

    @property
    def order(self) -> int:
        """Order of the autoregression."""
        return int(self.regression.shape[1])


@dataclass(frozen=True)
class LikelyNoise:
    """The most likely noise, and how uncertain it is.

    Attributes:
        noise: The noise.
        axes: Independent standard deviations of its logarithms and of the inverse hyperbolic
            tangents of its partial autocorrelations, one a row.
    """

    noise: Noise
    axes: Vector

    def nearby(self) -> Iterator[tuple[Noise, Noise]]:
        """Yield the noise half a standard deviation to both sides along each axis."""
        x = _packed(self.noise)
        for axis in self.axes:
            ahead, behind = (_unpacked(x + sign * _APART * axis, self.noise) for sign in (1, -1))
            yield ahead, behind


class Whitener:
    """Turns residuals and columns into ones with independent errors of variance 1.

    Args:
        blocks: Derivatives of the torques by the positions of the sample before, its own and the
            next one, shape (3, samples, joints, positions), in deviations of the encoders.
        used: Which torques count, shape (samples, joints).
    """

    def __init__(self, blocks: Vector, used: Array) -> None:
        self._used, self._blocks = used, blocks
        before, own, after = blocks
        self._products = [
            before @ _turned(before) + own @ _turned(own) + after @ _turned(after),
            own[:-1] @ _turned(before[1:]) + after[:-1] @ _turned(own[1:]),
            after[:-2] @ _turned(before[2:]),
        ]

    def filtered(self, values: Vector, noise: Noise) -> Vector:
        """Return values, shape (samples, joints, ...), filtered by the autoregression.

        Values before the first ones count as 0.
        """
        found = values.astype(np.float64, copy=True)
        shape = (-1, *(1,) * (values.ndim - 2))
        for back, weights in enumerate(noise.regression.T, 1):
            found[back:] -= weights.reshape(shape) * values[:-back]
        return found

    def factor(self, noise: Noise) -> Vector:
        """Return the Cholesky factor of the covariance of the filtered residual, banded."""
        order, (count, joints) = noise.order, self._used.shape
        weights = np.concatenate([np.ones((joints, 1)), -noise.regression], axis=1)
        width = min(order + (2 if noise.encoder else 0), count - 1)
        band = np.zeros(((width + 1) * joints, count * joints))
        columns = band.reshape(len(band), count, joints)
        own = np.arange(joints)
        left_out = np.where(self._used, 0.0, self._anything(noise))
        for ahead in range(width + 1):
            block = np.zeros((count - ahead, joints, joints))  # rows k, columns k + ahead
            for a, b in itertools.product(range(order + 1), repeat=2):
                lag = ahead + a - b  # of row k - a and column k + ahead - b
                if noise.encoder and abs(lag) <= 2:
                    first = max(0, a, b - ahead)
                    start = first - a + min(lag, 0)
                    part = self._products[abs(lag)][start : start + count - ahead - first]
                    part = part if lag >= 0 else _turned(part)
                    scale = noise.encoder**2 * np.outer(weights[:, a], weights[:, b])
                    block[first : first + len(part)] += scale * part
                if lag == 0:
                    scale = weights[:, a] * weights[:, b]
                    block[a:, own, own] += scale * left_out[: count - ahead - a]
            for i, j in itertools.product(range(joints), repeat=2):
                place = ahead * joints + j - i
                if place >= 0:
                    columns[place, : count - ahead, i] = block[:, i, j]
        columns[0] += noise.torque**2
        begun = _beginning(noise) if order else np.zeros((joints, 0, 0))
        for row, ahead in itertools.combinations_with_replacement(range(order), 2):
            columns[(ahead - row) * joints, row] += begun[:, row, ahead]
        factor: Vector = cholesky_banded(band, lower=True, check_finite=False)
        return factor

    def _anything(self, noise: Noise) -> Vector:
        """Return the variance of torques that do not count, shape (joints,)."""
        encoder = np.diagonal(self._products[0], axis1=1, axis2=2).mean(axis=0)
        found: Vector = _ANYTHING**2 * (noise.torque**2 + noise.encoder**2 * encoder)
        return found

    def whitened(self, values: Vector, noise: Noise, factor: Vector | None = None) -> Vector:
        """Return values, shape (samples, joints, ...), whitened, shape (rows, ...)."""
        factor = self.factor(noise) if factor is None else factor
        found = self.filtered(
            np.where(self._used.reshape(*self._used.shape, *(1,) * (values.ndim - 2)), values, 0.0),
            noise,
        )
        flat = found.reshape(found.shape[0] * found.shape[1], -1)
        solved, _ = lapack.dtbtrs(factor, flat, uplo="L")
        white: Vector = solved.reshape(-1, *values.shape[2:])
        return white

    def corrections(self, residual: Vector, noise: Noise) -> Vector:
        """Return what positions have to be corrected by, given the torques' residual.

        What is left of their errors is then uncorrelated with the residual.

        Args:
            residual: Shape (samples, joints), in N m or N.
            noise: Noise of the log.

        Returns:
            Shape (samples + 2, positions), in what the blocks are derivatives by.
        """
        factor = self.factor(noise)
        white = self.whitened(residual, noise, factor)
        solved, _ = lapack.dtbtrs(factor, white[:, None], uplo="L", trans="T")
        solved, count = solved.reshape(residual.shape), len(residual)
        back = solved.copy()
        for lag, weights in enumerate(noise.regression.T, 1):
            back[:-lag] -= weights * solved[lag:]
        found = np.zeros((count + 2, self._blocks.shape[-1]))
        for place, blocks in enumerate(self._blocks):
            found[place : place + count] += np.einsum("kij,ki->kj", blocks, back)
        return noise.encoder**2 * found

    def draw(self, noise: Noise) -> tuple[Vector, Vector]:
        """Return errors of the positions, as of `corrections`, and the residual that they leave.

        The latter has errors of the torques too. It is the same draw every time.
        """
        random, (count, joints) = np.random.default_rng(0), self._used.shape
        errors = noise.encoder * random.standard_normal((count + 2, self._blocks.shape[-1]))
        residual = noise.torque * random.standard_normal((count, joints))
        for joint, weights in enumerate(noise.regression):
            residual[:, joint] = lfilter([1.0], [1.0, *-weights], residual[:, joint])
        for place, blocks in enumerate(self._blocks):
            residual -= np.einsum("kij,kj->ki", blocks, errors[place : place + count])
        return errors, residual

    def loss(
        self,
        residual: Vector,
        noise: Noise,
        columns: Vector | None = None,
        known: Vector | None = None,
    ) -> float:
        """Return minus the logarithm of the likelihood of a residual.

        Args:
            residual: Shape (samples, joints).
            noise: The noise.
            columns: What the residual was fitted with, shape (samples, joints, columns), of full
                rank: the likelihood is then the restricted one, of what no fit of them changes.
            known: What is known of these columns' values beforehand, as rows with residuals of
                variance 1 at their ends, shape (rows, columns + 1).
        """
        factor = self.factor(noise)
        values = residual[..., None]
        if columns is not None:
            values = np.concatenate([columns, values], axis=2)
        white = self.whitened(values, noise, factor)
        if known is not None:
            white = np.concatenate([white, known])
        left = np.abs(np.diag(np.linalg.qr(white, mode="r")))
        volume = np.log(factor[0]).sum() + np.log(left[:-1]).sum()
        volume -= 0.5 * np.sum(~self._used * np.log(self._anything(noise)))
        return float(volume + 0.5 * left[-1] ** 2)

    def fit(
        self,
        residual: Vector,
        start: Noise,
        columns: Vector | None = None,
        known: Vector | None = None,
    ) -> LikelyNoise:
        """Return the most likely noise of a residual, of the same order as the start.

        Newton's method along the axes of the information in the residual's spectrum.

        Args:
            residual: As of `loss`.
            start: Where to start.
            columns: As of `loss`.
            known: As of `loss`.
        """

        def loss(x: Vector) -> float:
            try:
                found = self.loss(residual, _unpacked(x, start), columns, known)
                found += _prior(x, start)[0]
            except np.linalg.LinAlgError:
                return _NEVER
            return found if np.isfinite(found) else _NEVER

        x = min((_packed(each) for each in (start, _usual(start))), key=loss)
        axes = _Spectrum(residual, self._products).axes(_unpacked(x, start))
        lowest = loss(x)
        for _ in range(_ITERATIONS):
            ends = np.array([[loss(x + sign * _APART * axis) for sign in (1, -1)] for axis in axes])
            slopes = (ends[:, 0] - ends[:, 1]) / (2 * _APART)
            curves = np.clip((ends.sum(axis=1) - 2 * lowest) / _APART**2, _FLATTEST, None)
            step = np.clip(-slopes / curves, -_FARTHEST, _FARTHEST)
            if np.abs(step * np.sqrt(curves)).max() < _NEAR_ENOUGH:
                break
            while (found := loss(x + step @ axes)) > lowest and np.abs(step).max() > _NOWHERE:
                step = 0.5 * step
            if found > lowest:
                break
            x, lowest = x + step @ axes, found
        return LikelyNoise(_unpacked(x, start), axes / np.sqrt(curves)[:, None])

    def guess(self, residual: Vector, orders: int) -> Noise:
        """Return the noise that a residual's spectrum shows; its order is that of the lowest BIC.

        The likelihood of a spectrum ignores that the band changes along the path and that torques
        are left out, and takes no time.

        Args:
            residual: Shape (samples, joints), in N m or N.
            orders: Highest order.
        """
        spectrum = _Spectrum(residual, self._products)
        best: tuple[float, Noise] | None = None
        for order in range(min(1, orders), orders + 1):
            found = min((spectrum.fit(each) for each in spectrum.starts(order)), key=lambda x: x[0])
            cost = found[0] + 0.5 * order * residual.shape[1] * np.log(len(residual))
            if best is not None and cost > best[0]:
                break
            best = cost, found[1]
        assert best is not None
        return best[1]


class _Spectrum:
    """Likelihood of the noise given a residual's spectrum."""

    def __init__(self, residual: Vector, products: Sequence[Vector]) -> None:
        count, self._joints = residual.shape
        taper = np.hanning(count)[:, None]
        taper /= np.sqrt(np.mean(taper**2))
        self._power = np.abs(np.fft.rfft(residual * taper, axis=0)[1:]) ** 2 / count
        self._turns = np.exp(-2j * np.pi * np.arange(1, len(self._power) + 1) / count)[:, None]
        shares = np.zeros(self._power.shape)
        for lag, each in enumerate(products):
            mean = np.diagonal(each, axis1=1, axis2=2).mean(axis=0)
            shares += (1 + (lag > 0)) * (self._turns**lag).real * mean
        self._shares = np.maximum(shares, 1e-12 * shares.max())

    def starts(self, order: int) -> list[Noise]:
        """Return where to start the fit of an order."""
        end = slice(-len(self._power) // 4, None)
        encoder = float(np.sqrt(np.median(self._power[end] / self._shares[end]) / np.log(2)))
        total = np.sqrt(self._power.mean(axis=0))
        found = [Noise(encoder, total, np.zeros((self._joints, order)))]
        if order:
            slow = np.zeros((self._joints, order))
            slow[:, 0] = 0.9
            found.append(Noise(encoder, 0.5 * total, slow))
        return found

    def fit(self, start: Noise) -> tuple[float, Noise]:
        """Return minus the logarithm of the likelihood, and the noise where it is lowest."""
        begin = _packed(start)
        bounds = _bounds(begin, start)
        found = minimize(
            self._loss, begin, args=(start,), jac=True, method="L-BFGS-B", bounds=bounds
        )
        return float(found.fun), _unpacked(found.x, start)

    def _loss(self, x: Vector, like: Noise) -> tuple[float, Vector]:
        spectrum, slopes = self._shape(x, like)
        ratio = self._power / spectrum
        prior, slope = _prior(x, like)
        found = np.tensordot(slopes, 1 - ratio, 2) + slope
        return float(np.sum(np.log(spectrum) + ratio)) + prior, found

    def axes(self, noise: Noise) -> Vector:
        """Return independent standard deviations of packed noise, one a row, 1 at most."""
        x = _packed(noise)
        slopes = self._shape(x, noise)[1].reshape(len(x), -1)
        values, turns = np.linalg.eigh(slopes @ slopes.T)
        axes: Vector = turns.T / np.sqrt(np.maximum(values, 1.0))[:, None]
        return axes

    def _shape(self, x: Vector, like: Noise) -> tuple[Vector, Vector]:
        """Return the spectrum, and the derivatives of its logarithm by packed noise."""
        noise, joints = _unpacked(x, like), self._joints
        encoder = noise.encoder**2 * self._shares
        torque = noise.torque**2 * self._gain(noise.regression)
        slopes = np.zeros((len(x), *torque.shape))
        slopes[0] = 2 * encoder
        own = np.arange(joints)
        slopes[1 + own, :, own] = 2 * torque.T
        partial = x[1 + joints :].reshape(joints, -1)
        for place in range(like.order):
            near = partial.copy()
            near[:, place] += _NEAR
            by = (self._gain(_regression(np.tanh(near))) * noise.torque**2 - torque) / _NEAR
            slopes[1 + joints + place + like.order * own, :, own] = by.T
        spectrum = encoder + torque
        return spectrum, slopes / spectrum

    def _gain(self, regression: Vector) -> Vector:
        response = np.ones(self._power.shape, np.complex128)
        for lag, weights in enumerate(regression.T, 1):
            response -= self._turns**lag * weights
        gain: Vector = 1 / (response.real**2 + response.imag**2)
        return gain


def _prior(x: Vector, like: Noise) -> tuple[float, Vector]:
    """Return minus the logarithm of the prior of packed noise, and its slope.

    Noise of torques is rarely alternating, and encoders that hide all but the slowest of it tell no
    autocorrelation; what a log tells at all outweighs this.
    """
    slope = np.zeros(len(x))
    partial = slope[1 + len(like.torque) :].reshape(len(like.torque), -1)
    partial[:] = x[1 + len(like.torque) :].reshape(partial.shape)
    if like.order:
        partial[:, 0] -= _USUAL
    return 0.5 * float(slope @ slope), slope


def _usual(noise: Noise) -> Noise:
    """Return noise with usual autocorrelations, and the same slow torques."""
    partial = np.zeros(noise.regression.shape)
    partial[:, :1] = np.tanh(_USUAL)
    regression = _regression(partial)
    slow = (1 - regression.sum(axis=1)) / (1 - noise.regression.sum(axis=1))
    return Noise(noise.encoder, noise.torque * slow, regression)


def _packed(noise: Noise) -> Vector:
    partial = np.clip(_partial(noise.regression), -0.9999, 0.9999)
    return np.concatenate([
        [np.log(max(noise.encoder, 1e-12))], np.log(noise.torque), np.arctanh(partial).ravel()
    ])  # fmt: skip


def _unpacked(x: Vector, like: Noise) -> Noise:
    joints, order = like.regression.shape
    partial = np.tanh(x[1 + joints :].reshape(joints, order))
    return Noise(float(np.exp(x[0])), np.exp(x[1 : 1 + joints]), _regression(partial))


def _bounds(begin: Vector, like: Noise) -> list[tuple[float, float]]:
    joints = len(like.torque)
    around = [(x - 9.0, x + 9.0) for x in begin[: 1 + joints].tolist()]
    return [*around, *like.regression.size * [(-5.0, 5.0)]]


def _turned(matrices: Vector) -> Vector:
    return matrices.swapaxes(-1, -2)


def _regression(partial: Vector) -> Vector:
    """Return the coefficients of partial autocorrelations below 1, which are stable."""
    found = np.zeros((len(partial), 0))
    for each in partial.T:
        found = np.concatenate([found - each[:, None] * found[:, ::-1], each[:, None]], axis=1)
    return found


def _beginning(noise: Noise) -> Vector:
    """Return by what the covariance of the first filtered torques is more than later.

    Noise did not begin with the log: nothing is taken away from its first samples for those before.

    Returns:
        Shape (joints, order, order), zeros but for the samples that lack one before.
    """
    partial, order = _partial(noise.regression), noise.order
    known = [noise.torque**2 / np.prod(1 - partial**2, axis=1)]
    for lag in range(1, order):
        known.append(np.sum(_regression(partial[:, :lag]).T * np.array(known[::-1]), axis=0))
    found = np.zeros((len(partial), order, order))
    for joint, weights in enumerate(noise.regression):
        filters = np.eye(order)
        for lag, weight in enumerate(weights[: order - 1], 1):
            filters -= weight * np.eye(order, k=-lag)
        found[joint] = filters @ toeplitz([each[joint] for each in known]) @ filters.T
        found[joint] -= noise.torque[joint] ** 2 * np.eye(order)
    return found


def _partial(regression: Vector) -> Vector:
    """Return the partial autocorrelations of coefficients."""
    rest = regression
    found: list[Vector] = []
    while rest.shape[1]:
        last = np.clip(rest[:, -1:], -0.999, 0.999)
        found.insert(0, last[:, 0])
        rest = (rest[:, :-1] + last * rest[:, :-1][:, ::-1]) / (1 - last**2)
    return np.stack(found, axis=1) if found else np.zeros((len(regression), 0))
