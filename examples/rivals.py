"""The rivals that the examples compare networks with: cheap maps, and a verdict over several seeds.

Errors are relative: the norm of the difference divided by the norm of the exact value, averaged
over the samples. The network with the worst seed must beat the best rival.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np


def linear_map(inputs: np.ndarray, outputs: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Fit a linear map by ridge regression; a held-out fifth of the samples sets the penalty."""
    flat, wanted = inputs.reshape(len(inputs), -1), outputs.reshape(len(outputs), -1)
    center, mean, known = flat.mean(0), wanted.mean(0), len(flat) * 4 // 5

    def fit(rows: slice, penalty: float) -> np.ndarray:
        x, y = flat[rows] - center, wanted[rows] - mean
        return np.linalg.solve(x.T @ x + penalty * np.eye(x.shape[1]), x.T @ y)

    def held_back(penalty: float) -> float:
        guess = (flat[known:] - center) @ fit(slice(known), penalty)
        return float(((guess - wanted[known:] + mean) ** 2).mean())

    best = fit(slice(None), min(10.0 ** np.arange(-6, 5), key=held_back))
    return lambda x: ((x.reshape(len(x), -1) - center) @ best + mean).reshape(
        -1, *outputs.shape[1:]
    )


def relative_error(guess: np.ndarray, exact: np.ndarray) -> float:
    """Return the mean relative error of samples, shape (rows, ...) each."""
    norms = [np.linalg.norm(each.reshape(len(each), -1), axis=1) for each in (guess - exact, exact)]
    return float(np.mean(norms[0] / norms[1]))


def table(
    errors: Mapping[str, Sequence[float]], what: str = "relative error", form: str = ".2%"
) -> None:
    """Print each candidate's mean error over the seeds, and that of its worst seed."""
    print(f"\n{what:28}{'mean':>10}{'worst seed':>12}")
    for name, found in errors.items():
        print(f"{name:28}{np.mean(found):>10{form}}{max(found):>12{form}}")


def verdict(
    errors: Mapping[str, Sequence[float]],
    network: str,
    *,
    what: str = "relative error",
    form: str = ".2%",
    references: Sequence[str] = (),
) -> int:
    """Print mean and worst errors; return 0 if the network's worst error beats the best rival.

    References are printed but are not rivals.
    """
    table(errors, what, form)
    others = errors.keys() - {network, *references}
    means = {name: np.mean(errors[name]) for name in errors if name in others}
    rival = min(means, key=means.get)
    ratio = np.mean(errors[network]) / means[rival]
    print(f"\n{network}: {ratio:.2f} times the error of the best rival, {rival}")
    return int(max(errors[network]) >= means[rival])
