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
    [verdict] = [line for line in lines if line.startswith("network: ")]
    assert verdict.endswith(f" times the error of the best rival, {best}")


ARMS = {
    "nothing": [32.0],
    "linear map": [10.0],
    "gravity": [4.0],
    "narrow": [0.6],
    "wide": [0.4, 0.6],
    "exact": [0.02],
}
KINDS = {"networks": ["narrow", "wide"], "alone": "nothing", "references": ["exact"]}


def test_a_verdict_ends_with_what_a_person_would_do_without_the_network(rivals, capsys):
    assert rivals.verdict(ARMS, "wide", **KINDS) == 1  # its worst seed is as good as the narrow one
    lines = capsys.readouterr().out.splitlines()[-3:]
    assert lines[0] == "wide: 0.83 times the error of the best rival, narrow"
    best = "8 times closer than gravity, the best without a network"
    assert lines[1] == f"wide: 64 times closer than nothing, {best}"
    assert lines[2] == "exact: 25 times closer than wide"
    worse = {**ARMS, "wide": [8.0], "narrow": [9.0]}
    assert rivals.verdict(worse, "wide", **KINDS) == 1
    told = capsys.readouterr().out.splitlines()[-2]
    assert told.endswith("2 times farther off than gravity, the best without a network")
    alone = {name: errors for name, errors in ARMS.items() if name not in ("gravity", "linear map")}
    rivals.verdict(alone, "wide", **KINDS)
    told = capsys.readouterr().out.splitlines()[-2]
    assert told == "wide: 64 times closer than nothing, the best without a network"


@pytest.mark.parametrize("wide", [[0.1], [900.0]])
def test_a_small_run_is_not_judged(wide, rivals, capsys):
    assert rivals.verdict({**ARMS, "wide": wide}, "wide", small=True, **KINDS) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[-1].startswith("Too small to judge: ")
    assert "linear map" in out and "times" not in out
