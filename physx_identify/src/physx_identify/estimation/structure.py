"""Tests of what is left: does the residual keep a structure that the model lacks?

Each is a test of what columns along the path that the noise does not reach would add to the model.
With the uncertainty of the noise, it has its stated size: together, the tests find something in at
most one of twenty logs without model error.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr
from scipy.stats import chi2
from scipy.stats import f as fisher

from physx_core.typing import Vector
from physx_identify.estimation.fit import Fit
from physx_identify.estimation.model import STRIBECK
from physx_identify.estimation.noise import LikelyNoise
from physx_identify.estimation.uncertainty import NEW, Values, values_of

SIZE = 0.03
"""Share of logs without model error in which the tests together find one, by their probabilities;
these are approximate, and 1 of 20 is promised."""
_LAGS = 8


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
    rows = slice(found.path.own.shape[1] - len(joints), None)
    speed, place, accelerations = (
        each[:, rows] for each in (found.path.ends, found.path.own, found.path.accelerations)
    )
    place = place - place.mean(axis=0)
    sign = np.sign(speed)
    stribeck = sign * np.exp(-np.abs(speed) / STRIBECK)
    stops = speed * accelerations < 0
    columns = {
        "friction that falls with speed (Stribeck)": stribeck,
        "dry friction that fades as a joint stops, as MuJoCo's (see slowest)": stops * stribeck,
        "a resistance that grows with the square of speed": speed * np.abs(speed),
        "a resistance in proportion to speed (damping)": speed,
        "dry friction": sign,
        "an inertia (armature)": accelerations,
        "a constant torque, or friction that depends on the direction": np.ones_like(speed),
        "a torque that depends on the position": place,
        "friction that grows with the load": sign * np.abs(found.torques),
    }
    lacks = [(name, each) for name in joints for each in columns]
    features = np.zeros((*speed.shape, len(lacks)))
    for number, (name, each) in enumerate(lacks):
        joint = joints.index(name)
        features[:, joint, number] = columns[each][:, joint]
    late = found.regressors.copy()
    late[: len(late) // 2] = 0.0
    lacks.append(("", "something that changes with time: the halves of the log differ"))
    groups = [np.array([number]) for number in range(features.shape[2])]
    groups.append(np.arange(features.shape[2], features.shape[2] + late.shape[2]))
    beside = values_of(
        found.whitener,
        _noise_beside(found, features),
        found.residual,
        found.regressors,
        found.known,
        np.concatenate([features, late], axis=2),
        groups,
    )
    for (name, each), values in zip(lacks, beside, strict=True):
        if len(values.values):
            yield name, each, _probability(values)
    yield (
        "",
        "noise as it is: what is left is still correlated, as by contacts or flexible links",
        _whiteness(found),
    )


def _noise_beside(found: Fit, features: Vector) -> LikelyNoise:
    """Return the noise as it is if the model has all features: what it lacks is no noise."""
    columns = np.concatenate([found.regressors, features], axis=2)
    white = found.whitener.whitened(columns, found.noise)
    white = np.concatenate([white, np.pad(found.known[:, :-1], ((0, 0), (0, features.shape[2])))])
    count = found.regressors.shape[2]
    basis = np.linalg.qr(white[:, :count])[0]
    rest = white[:, count:] / np.maximum(np.linalg.norm(white[:, count:], axis=0), 1e-300)
    rest -= basis @ (basis.T @ rest)
    _, triangle, order = qr(rest, mode="economic", pivoting=True)
    new = np.sort(order[np.abs(np.diag(triangle)) > NEW])
    known = np.insert(found.known, [count] * len(new), 0.0, axis=1)
    columns = np.concatenate([found.regressors, features[..., new]], axis=2)
    return found.whitener.fit(found.residual, found.noise, columns, known)


def _probability(found: Values) -> float:
    """Return the probability of values as far from 0."""
    size = len(found.values)
    square = found.values @ np.linalg.solve(found.covariance, found.values)
    freedom = size / np.sum(1 / found.freedom)
    return float(fisher.sf(square / size, size, freedom))


def _whiteness(found: Fit) -> float:
    """Return the probability of the correlations of the whitened residual with itself."""
    used = found.used
    white = np.where(used, found.white[: used.size].reshape(used.shape), 0.0)
    count = used.sum(axis=0)
    power = np.sum(white**2, axis=0) / count
    value = 0.0
    for lag in range(1, _LAGS + 1):
        pairs = np.maximum(np.sum(used[lag:] & used[:-lag], axis=0), 1)
        correlation = np.sum(white[lag:] * white[:-lag], axis=0) / power
        value += float(np.sum((count + 2) / count * correlation**2 / pairs))
    return float(chi2.sf(value, _LAGS * used.shape[1] - found.noise.regression.size))
