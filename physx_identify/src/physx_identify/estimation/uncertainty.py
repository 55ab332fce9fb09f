"""Uncertainty of values when the noise that they were weighted with is itself estimated.

As of Kenward and Roger (Biometrics 53, 1997): another noise, as likely, would have given other
values, which adds to their covariance; and other errors, which makes their distribution Student's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from physx_core.typing import Array, Vector
from physx_identify.estimation.noise import LikelyNoise, Noise, Whitener

NEW = 0.03
"""Relative length of a column that the others do not explain, from which it counts."""


@dataclass(frozen=True)
class Values:
    """Values of generalized least squares.

    Attributes:
        values: Shape (values,).
        covariance: Shape (values, values).
        freedom: Degrees of freedom of each value's error, shape (values,).
    """

    values: Vector
    covariance: Vector
    freedom: Vector


def values_of(
    whitener: Whitener,
    likely: LikelyNoise,
    residual: Vector,
    columns: Vector,
    known: Vector,
    features: Vector | None = None,
    groups: Sequence[Array] = (),
) -> list[Values]:
    """Return what a residual has of columns; or of each group of features beside the columns.

    Args:
        whitener: Of the log.
        likely: Its noise.
        residual: Shape (samples, joints).
        columns: Shape (samples, joints, columns), of full rank.
        known: What is known of the columns' values beforehand, as rows with residuals at their
            ends, shape (rows, columns + 1).
        features: Further ones, shape (samples, joints, features).
        groups: Places of the features that belong together. What columns explain of them is left
            out, and a group is empty if that is all.
    """
    solver = _Solver(whitener, residual, columns, known, features, groups)
    middle = solver(likely.noise)
    ends = [(solver(ahead), solver(behind)) for ahead, behind in likely.nearby()]
    found = []
    for place, (values, covariance) in enumerate(middle):
        size = len(values)
        shifts, growths = np.zeros((2, len(ends), size))
        for row, (ahead, behind) in enumerate(ends):
            shifts[row] = ahead[place][0] - behind[place][0]
            variances = (np.diag(side[place][1]) for side in (ahead, behind))
            growths[row] = np.subtract(*map(np.log, variances))
        freedom = 2 / np.maximum(np.sum(growths**2, axis=0), 2 / residual.size)
        found.append(Values(values, covariance + 2 * shifts.T @ shifts, np.maximum(freedom, 1.0)))
    return found


class _Solver:
    """Solves for the values of all groups under any noise."""

    def __init__(
        self,
        whitener: Whitener,
        residual: Vector,
        columns: Vector,
        known: Vector,
        features: Vector | None,
        groups: Sequence[Array],
    ) -> None:
        self._whitener, self._count = whitener, columns.shape[2]
        parts = [columns, residual[..., None]]
        self._values = np.concatenate(parts if features is None else [*parts, features], axis=2)
        self._known = np.zeros((len(known), self._values.shape[2]))
        self._known[:, : known.shape[1]] = known
        self._features, self._groups = features is not None, groups
        self._turns: list[Vector] = []

    def __call__(self, noise: Noise) -> list[tuple[Vector, Vector]]:
        """Return values and covariance of each group."""
        count = self._count
        white = np.concatenate([self._whitener.whitened(self._values, noise), self._known])
        scale = np.linalg.norm(white[:, :count], axis=0)
        basis, triangle = np.linalg.qr(white[:, :count] / scale)
        along = basis.T @ white[:, count:]
        if not self._features:
            inverse = np.linalg.inv(triangle) / scale[:, None]
            return [(inverse @ along[:, 0], inverse @ inverse.T)]
        rest = white[:, count:] - basis @ along
        if not self._turns:
            sizes = np.linalg.norm(white[:, count + 1 :], axis=0)
            sizes = np.maximum(sizes, 1e-300)
            for group in self._groups:
                unit = rest[:, 1 + group] / sizes[group]
                values, turns = np.linalg.eigh(unit.T @ unit)
                self._turns.append(turns[:, values > NEW**2] / sizes[group][:, None])
        found = []
        for group, turns in zip(self._groups, self._turns, strict=True):
            own = rest[:, 1 + group] @ turns
            inverse = np.linalg.inv(own.T @ own)
            found.append((inverse @ (own.T @ rest[:, 0]), inverse))
        return found
