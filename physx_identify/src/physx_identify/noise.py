"""Noise of a log: of the torques, autoregressive, and of the encoders, white.

The residual of the torques is ``e - B n``: ``e`` are errors of the torques, which for a commanded
torque are disturbances, and ``n`` those of the encoders, which ``B``, the derivative of the torques
by the positions of three neighboring samples, turns into torques. Filtered by the autoregression,
their covariance is a band: it is built, factorized and inverted exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded, lapack
from scipy.optimize import minimize

from physx_core.typing import Array, Vector

ORDERS = 2
"""Highest order of the autoregression of torques."""
_ITERATIONS = 8
_NEVER = 1e12
_NEAR = 1e-6


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


class Whitener:
    """Turns residuals and columns into ones with independent errors of variance 1.

    Args:
        blocks: Derivatives of the torques by the positions of the sample before, its own and the
            next one, shape (3, samples, joints, joints).
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

    def rows(self, order: int) -> Array:
        """Return which filtered torques count, shape (samples - order, joints)."""
        end = len(self._used) - order
        found = self._used[order:].copy()
        for back in range(1, order + 1):
            found &= self._used[order - back : order - back + end]
        return found

    def filtered(self, values: Vector, noise: Noise) -> Vector:
        """Return values, shape (samples, joints, ...), filtered by the autoregression."""
        order = noise.order
        end = len(values) - order
        found = values[order:].astype(np.float64, copy=True)
        shape = (-1, *(1,) * (values.ndim - 2))
        for back in range(1, order + 1):
            weights = noise.regression[:, back - 1].reshape(shape)
            found -= weights * values[order - back : order - back + end]
        found[~self.rows(order)] = 0.0
        return found

    def factor(self, noise: Noise) -> Vector:
        """Return the Cholesky factor of the covariance of the filtered residual, banded."""
        order, rows = noise.order, self.rows(noise.order)
        count, joints = rows.shape
        weights = np.concatenate([np.ones((joints, 1)), -noise.regression], axis=1)
        width = 0 if noise.encoder == 0 else min(order + 2, count - 1)
        band = np.zeros(((width + 1) * joints, count * joints))
        columns = band.reshape(len(band), count, joints)
        if noise.encoder:
            for ahead in range(width + 1):
                block = np.zeros((count - ahead, joints, joints))  # rows k, columns k + ahead
                for a in range(order + 1):
                    for b in range(order + 1):
                        lag = ahead + a - b
                        if abs(lag) > 2:
                            continue
                        start = order - a + min(lag, 0)
                        part = self._products[abs(lag)][start : start + count - ahead]
                        part = part if lag >= 0 else _turned(part)
                        block += np.outer(weights[:, a], weights[:, b]) * part
                block *= noise.encoder**2 * (rows[: count - ahead, :, None] & rows[ahead:, None, :])
                for i in range(joints):
                    for j in range(joints):
                        place = ahead * joints + j - i
                        if place >= 0:
                            columns[place, : count - ahead, i] = block[:, i, j]
        columns[0] += np.where(rows, noise.torque**2, 1.0)
        factor: Vector = cholesky_banded(band, lower=True, check_finite=False)
        return factor

    def whitened(self, values: Vector, noise: Noise, factor: Vector | None = None) -> Vector:
        """Return values, shape (samples, joints, ...), whitened, shape (rows, ...)."""
        factor = self.factor(noise) if factor is None else factor
        found = self.filtered(values, noise)
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
            Shape (samples + 2, joints), in rad or m.
        """
        factor, rows = self.factor(noise), self.rows(noise.order)
        white = self.whitened(residual, noise, factor)
        solved, _ = lapack.dtbtrs(factor, white[:, None], uplo="L", trans="T")
        solved = solved.reshape(rows.shape) * rows
        order, (count, joints) = noise.order, residual.shape
        back = np.zeros((count, joints))
        back[order:] = solved
        for lag in range(1, order + 1):
            back[order - lag : count - lag] -= noise.regression[:, lag - 1] * solved
        found = np.zeros((count + 2, joints))
        for place, blocks in enumerate(self._blocks):
            found[place : place + count] += np.einsum("kij,ki->kj", blocks, back)
        return noise.encoder**2 * found

    def draw(self, noise: Noise) -> tuple[Vector, Vector]:
        """Return errors of the encoders, shape (samples + 2, joints), and the residual they leave.

        The latter has errors of the torques too. It is the same draw every time.
        """
        random, (count, joints) = np.random.default_rng(0), self._used.shape
        errors = noise.encoder * random.standard_normal((count + 2, joints))
        residual = noise.torque * random.standard_normal((count, joints))
        for row in range(noise.order, count):
            for lag, weights in enumerate(noise.regression.T, 1):
                residual[row] += weights * residual[row - lag]
        for place, blocks in enumerate(self._blocks):
            residual -= np.einsum("kij,kj->ki", blocks, errors[place : place + count])
        return errors, residual

    def loss(self, residual: Vector, noise: Noise) -> float:
        """Return minus the logarithm of the likelihood of a residual."""
        factor = self.factor(noise)
        white = self.whitened(residual, noise, factor)
        return float(np.log(factor[0]).sum() + 0.5 * white @ white)

    def fit(self, residual: Vector, start: Noise) -> Noise:
        """Return the most likely noise of a residual, of the same order as the start."""

        def loss(x: Vector) -> float:
            try:
                found = self.loss(residual, _unpacked(x, start))
            except np.linalg.LinAlgError:
                return _NEVER
            return found if np.isfinite(found) else _NEVER

        begin = _packed(start)
        bounds = _bounds(begin, start)
        options = {"ftol": 1e-8, "maxiter": _ITERATIONS}
        found = minimize(loss, begin, method="L-BFGS-B", bounds=bounds, options=options)
        return _unpacked(found.x, start)

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
        for order in range(orders + 1):
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
        noise, joints = _unpacked(x, like), self._joints
        encoder = noise.encoder**2 * self._shares
        torque = noise.torque**2 * self._gain(noise.regression)
        spectrum = encoder + torque
        slope = (1 - self._power / spectrum) / spectrum
        found = np.empty(len(x))
        found[0] = np.sum(slope * 2 * encoder)
        found[1 : 1 + joints] = np.sum(slope * 2 * torque, axis=0)
        partial = x[1 + joints :].reshape(joints, -1)
        for place in range(like.order):
            near = partial.copy()
            near[:, place] += _NEAR
            by = (self._gain(_regression(np.tanh(near))) * noise.torque**2 - torque) / _NEAR
            found[1 + joints + place :: like.order] = np.sum(slope * by, axis=0)
        return float(np.sum(np.log(spectrum) + self._power / spectrum)), found

    def _gain(self, regression: Vector) -> Vector:
        response = np.ones(self._power.shape, np.complex128)
        for lag, weights in enumerate(regression.T, 1):
            response -= self._turns**lag * weights
        gain: Vector = 1 / (response.real**2 + response.imag**2)
        return gain


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


def _partial(regression: Vector) -> Vector:
    """Return the partial autocorrelations of coefficients."""
    rest = regression
    found: list[Vector] = []
    while rest.shape[1]:
        last = np.clip(rest[:, -1:], -0.999, 0.999)
        found.insert(0, last[:, 0])
        rest = (rest[:, :-1] + last * rest[:, :-1][:, ::-1]) / (1 - last**2)
    return np.stack(found, axis=1) if found else np.zeros((len(regression), 0))
