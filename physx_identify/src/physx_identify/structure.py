"""Tests of what is left: does the residual keep a structure that the model lacks?

Each is a score test with columns along the path that the noise does not reach, so that it has its
stated size: together, the tests find something in at most one of twenty logs without model error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from physx_core.typing import Vector
from physx_identify.fit import Fit
from physx_identify.model import STRIBECK

SIZE = 0.05
"""Share of logs without model error in which the tests together find one."""
_LAGS = 8
_NEW = 1e-3
"""Relative length of a column that the fitted ones do not explain, from which it is tested."""


@dataclass(frozen=True)
class ResidualTest:
    """A test of the residual.

    Attributes:
        joint: Name of the joint; empty: all.
        lacks: What the model lacks if it fails.
        probability: That a value as large is found without model error.
        threshold: Probability below which it fails.
    """

    joint: str
    lacks: str
    probability: float
    threshold: float

    @property
    def failed(self) -> bool:
        """Whether the residual keeps this structure."""
        return self.probability < self.threshold


def structure_tests(found: Fit, joints: Sequence[str]) -> list[ResidualTest]:
    """Return the tests of a fit's residual."""
    raw = list(_tests(found, joints))
    return [ResidualTest(joint, lacks, p, SIZE / len(raw)) for joint, lacks, p in raw]


def _tests(found: Fit, joints: Sequence[str]) -> Iterator[tuple[str, str, float]]:
    noise, whitener, path = found.noise, found.whitener, found.path
    factor = whitener.factor(noise)
    count = noise.order, len(path.own)
    rows = (count[1] - count[0]) * len(joints)
    speed, place = path.ends, path.own - path.own.mean(axis=0)
    sign = np.sign(speed)
    columns = {
        "friction that falls with speed (Stribeck)": sign * np.exp(-np.abs(speed) / STRIBECK),
        "a resistance that grows with the square of speed": speed * np.abs(speed),
        "a resistance in proportion to speed (damping)": speed,
        "dry friction": sign,
        "an inertia (armature)": path.accelerations,
        "a constant torque, or friction that depends on the direction": np.ones_like(speed),
        "a torque that depends on the position": place,
        "friction that grows with the load": sign * np.abs(found.torques),
    }
    for joint, name in enumerate(joints):
        for lacks, values in columns.items():
            feature = np.zeros((*values.shape, 1))
            feature[:, joint, 0] = values[:, joint]
            white = np.zeros((len(found.white), 1))
            white[:rows] = whitener.whitened(feature, noise, factor)
            probability = _score(found, white)
            if probability is not None:
                yield name, lacks, probability
    late = np.zeros((len(found.white), 1))
    late[rows // 2 : rows] = 1.0
    halves = _score(found, late * found.instruments[:, found.independent])
    if halves is not None:
        yield "", "something that changes with time: the halves of the log differ", halves
    yield (
        "",
        "noise as it is: what is left is still correlated",
        _whiteness(found, len(joints), rows),
    )


def _score(found: Fit, features: Vector) -> float | None:
    """Return the probability of what is left along features; None: the fit explains them."""
    z, a = (each[:, found.independent] for each in (found.instruments, found.columns))
    scale = np.linalg.norm(features, axis=0)
    if not scale.all():
        return None
    features = features / scale
    rest = features - z @ np.linalg.solve(a.T @ z, a.T @ features)
    unexplained = features - z @ np.linalg.lstsq(z, features, rcond=None)[0]
    values, turns = np.linalg.eigh(unexplained.T @ unexplained)
    turns = turns[:, values > _NEW**2]
    if not turns.shape[1]:
        return None
    rest = rest @ turns
    score = rest.T @ found.white
    value = score @ np.linalg.lstsq(rest.T @ rest, score, rcond=None)[0]
    variance = found.white @ found.white / found.freedom
    return float(chi2.sf(value / variance, turns.shape[1]))


def _whiteness(found: Fit, joints: int, rows: int) -> float:
    """Return the probability of the correlations of the whitened residual with itself."""
    white = found.white[:rows].reshape(-1, joints)
    count = len(white)
    power = np.mean(white**2, axis=0)
    value = 0.0
    for lag in range(1, _LAGS + 1):
        correlation = np.sum(white[lag:] * white[:-lag], axis=0) / power / count
        value += float(count * (count + 2) / (count - lag) * np.sum(correlation**2))
    return float(chi2.sf(value, _LAGS * joints - found.noise.regression.size))
