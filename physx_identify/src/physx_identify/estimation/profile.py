"""Profiles: intervals of parameters in which torques are so curved that errors are asymmetric."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from physx_identify.estimation.fit import Fit, Problem

CURVED = ("delay", "encoder")
"""Kinds that torques are not linear in; of the others, the likelihood is quadratic."""
TOLERANCE = 0.25
"""Share by which twice the drop of the log-likelihood two standard errors away may differ from 4,
what it is where the likelihood is quadratic."""
_APART, _FARTHEST = 2.0, 8.0
"""Where that is looked at, in standard errors; longest half of an interval, in usual ones,
to which it is cut where a log tells no end."""


def profile_interval(
    problem: Problem,
    found: Fit,
    place: int,
    width: float,
) -> tuple[float, float] | None:
    """Return the interval of a parameter by the profile of the log-likelihood.

    Its ends are where the most that the others can make of it has dropped as far as it would, if it
    were quadratic, at the ends of the usual interval. With instruments, it is that of the whitened
    residual's part that they explain (the distance of Newey and West, International Economic Review
    28, 1987).

    Args:
        problem: Parameters in a log.
        found: What a fit of them found.
        place: Place of the parameter, an independent one.
        width: Half of the usual interval, in standard errors.

    Returns:
        Its ends; None: the likelihood is quadratic, and the usual interval is right.
    """
    if problem.parameters[place].kind not in CURVED:
        return None
    row, best = int(np.flatnonzero(found.independent == place)[0]), float(found.values[place])
    z, a = (each[:, found.independent] for each in (found.instruments, found.columns))
    inner = np.linalg.inv(z.T @ a)
    error = float(np.linalg.norm(z @ inner[row]))  # of the noise as it is
    stretch = float(np.sqrt(found.covariance[row, row])) / error
    least = problem.distance(found, place, best)

    def drop(errors: float) -> float:
        return 2.0 * (problem.distance(found, place, best + errors * error) - least)

    ends = drop(-_APART), drop(_APART)
    if max(abs(each / _APART**2 - 1) for each in ends) <= TOLERANCE:
        return None
    low, high = (_reached(drop, sign, width) for sign in (-1.0, 1.0))
    return best + stretch * error * low, best + stretch * error * high


def _reached(drop: Callable[[float], float], sign: float, width: float) -> float:
    """Return where the drop is the width's square, to one side, in standard errors."""
    far = width
    while drop(sign * far) < width**2 and far < _FARTHEST * width:
        far *= 2.0
    if drop(sign * far) < width**2:
        return sign * far
    found: float = brentq(lambda errors: drop(errors) - width**2, 0.0, sign * far, rtol=1e-3)
    return found
