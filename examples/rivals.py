"""The rivals that the examples compare networks with: cheap maps, and a verdict over several seeds.

Errors are relative: the norm of the difference divided by the norm of the exact value, averaged
over the samples. The network with the worst seed must beat the best rival.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

TOO_SMALL = "Too small to judge: this run only shows that it works. Without --small it compares."


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
    small: bool = False,
    what: str = "relative error",
    form: str = ".2%",
    networks: Sequence[str] = (),
    alone: str | None = None,
    references: Sequence[str] = (),
) -> int:
    """Print mean and worst errors; return 0 if the network's worst error beats the best rival.

    Args:
        errors: Errors of each candidate, one for each seed.
        network: The network to judge.
        small: Whether the run is too small to judge; nothing is compared then.
        what: Name and unit of the errors.
        form: Format of the errors.
        networks: Rivals that are networks, too. The network is also compared with the best of the
            others.
        alone: The rival that uses neither a network nor a model.
        references: Exact models, which are compared with the network but are not rivals.
    """
    table(errors, what, form)
    if small:
        print(f"\n{TOO_SMALL}")
        return 0
    means = {name: float(np.mean(found)) for name, found in errors.items()}
    rivals = [name for name in errors if name not in (network, *references)]
    rival = min(rivals, key=means.__getitem__)
    ratio = means[network] / means[rival]
    print(f"\n{network}: {ratio:.2f} times the error of the best rival, {rival}")
    if networks:
        best = min((n for n in rivals if n not in networks), key=means.__getitem__)
        compared = [f"{_times(means[network], means[best])} {best}, the best without a network"]
        if alone not in (None, best):
            compared.insert(0, f"{_times(means[network], means[alone])} {alone}")
        print(f"{network}: {', '.join(compared)}")
    for name in references:
        print(f"{name}: {_times(means[name], means[network])} {network}")
    return int(max(errors[network]) >= means[rival])


def _times(error: float, other: float) -> str:
    if error > other:
        return f"{error / other:.2g} times farther off than"
    return f"{other / error:.2g} times closer than"
