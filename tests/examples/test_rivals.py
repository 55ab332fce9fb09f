"""The rivals of networks are fitted as well as can be, and the verdict hangs on the best."""

import numpy as np
import pytest

pytest.importorskip("torch")

ERRORS = {"nothing": [0.5], "linear": [0.2, 0.4], "network": [0.1, 0.25], "truth": [0.05]}


@pytest.fixture
def rivals(module):
    return module("rivals")


def test_a_linear_map_finds_what_is_linear(rivals):
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(6, 4))

    def truth(x):
        return (x.reshape(-1, 6) @ matrix + 3.0).reshape(-1, 2, 2)

    known = rng.normal(size=(50, 3, 2))
    fitted = rivals.linear_map(known, truth(known))
    unseen = 10 * rng.normal(size=(20, 3, 2))
    assert rivals.relative_error(fitted(unseen), truth(unseen)) < 1e-6


def test_a_linear_map_of_few_noisy_samples_is_small(rivals):
    rng = np.random.default_rng(0)
    x, noise = rng.normal(size=(60, 50)), rng.normal(size=(60, 1))
    fitted = rivals.linear_map(x, noise)
    least_squares = np.linalg.lstsq(x, noise, rcond=None)[0]
    unseen = rng.normal(size=(500, 50))
    assert (fitted(unseen) ** 2).mean() < 0.2 * ((unseen @ least_squares) ** 2).mean()


@pytest.mark.parametrize(
    ("worst", "references", "status"),
    [(0.25, ["truth"], 0), (0.35, ["truth"], 1), (0.25, [], 1)],
)
def test_the_worst_seed_has_to_beat_the_mean_of_the_best_rival(
    worst, references, status, rivals, capsys
):
    errors = {**ERRORS, "network": [0.1, worst]}
    options = {"what": "error in m", "form": ".2f", "references": references}
    assert rivals.verdict(errors, "network", **options) == status
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["error", "in", "m", "mean", "worst", "seed"]
    assert ["linear", "0.30", "0.40"] in [line.split() for line in lines]
    best = "linear" if references else "truth"
    assert lines[-1].startswith("network: ")
    assert lines[-1].endswith(f" times the error of the best rival, {best}")
