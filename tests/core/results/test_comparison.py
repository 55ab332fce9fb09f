"""Candidates with several seeds are compared, and the worst of them must beat the best rival."""

import numpy as np
import pytest

from physx_core import Comparison, Result
from physx_core.errors import UsageError
from physx_core.results import FieldResult, PartResult, RivalResult

ERRORS = {"nothing": [0.5], "linear": [0.2, 0.4], "network": [0.1, 0.25], "truth": [0.05]}


@pytest.mark.parametrize(
    ("worst", "references", "wins"),
    [(0.25, ["truth"], True), (0.35, ["truth"], False), (0.25, [], False)],
)
def test_the_worst_seed_has_to_beat_the_mean_of_the_best_rival(worst, references, wins):
    errors = {**ERRORS, "network": [0.1, worst]}
    compared = Comparison(errors, "network", "error in m", references=references)
    assert compared.wins == wins
    lines = [line.split() for line in str(compared).splitlines()]
    assert lines[0] == ["error", "in", "m", "mean", "worst", "seed"]
    assert ["linear", "0.3", "0.4"] in lines and ["nothing", "0.5", "0.5"] in lines
    best = "linear" if references else "truth"
    ratio = np.mean(errors["network"]) / np.mean(errors[best])
    assert f"network: {ratio:.2f} times the error of the best rival, {best}" in str(compared)
    if references:
        assert f"truth: {np.mean(errors['network']) / 0.05:.2g} times closer than" in str(compared)


def test_the_best_rival_without_a_network_is_named_where_another_network_is_better():
    errors = {"nothing": [32.0], "gravity": [4.0], "narrow": [0.6], "wide": [0.4, 0.6]}
    compared = Comparison(errors, "wide", networks=["narrow", "wide"])
    assert not compared.wins  # its worst seed is as good as the narrow one
    verdict = str(compared).splitlines()[-2:]
    assert verdict[0] == "wide: 0.83 times the error of the best rival, narrow"
    assert verdict[1] == "wide: 8 times closer than gravity, the best without a network"
    worse = Comparison({**errors, "wide": [8.0], "narrow": [9.0]}, "wide", networks=["wide"])
    assert str(worse).splitlines()[-1].startswith("wide: 2.00 times the error of the best rival")


def result(error, unit="m", name="rmse", **rivals):
    found = {other: RivalResult({name: value}) for other, value in rivals.items()}
    found["nearest"] = RivalResult(why="not run")
    field = FieldResult("classes" if "acc" in name else "real", unit, {name: error}, rivals=found)
    part = PartResult(100, 10, "10 episodes", fields={"u": field})
    return Result("training", "sessions/x", 1.0, parts={"validation": part, "test": part})


@pytest.mark.parametrize("part", ["error", "test"])
def test_results_of_trainings_bring_their_rivals_and_their_unit(part):
    results = {"small": [result(0.3, mean=0.9), result(0.5)], "large": [result(0.2), result(0.1)]}
    compared = Comparison.of(results, f"{part}/u/rmse")
    assert compared.errors == {"mean": [0.9], "small": [0.3, 0.5], "large": [0.2, 0.1]}
    assert (compared.subject, compared.what) == ("large", "u: rmse in m")
    assert compared.wins and not Comparison.of(results, "error/u/rmse", "small").wins


def test_of_an_accuracy_what_is_missing_to_one_is_compared():
    results = {"network": [result(0.75, "", "accuracy", frequent=0.5)]}
    compared = Comparison.of(results, "error/u/accuracy")
    assert compared.errors == {"frequent": [0.5], "network": [0.25]} and compared.wins
    assert compared.what == "u: 1 - accuracy"


def test_what_cannot_be_compared_is_named():
    with pytest.raises(UsageError, match=r"no errors of 'netwerk', only of \['nothing'"):
        Comparison(ERRORS, "netwerk")
    with pytest.raises(UsageError, match="no errors of a rival"):
        Comparison({"network": [0.1]}, "network")
    with pytest.raises(UsageError, match=r"no errors of \['linear'\]"):
        Comparison({"linear": [], "network": [0.1]}, "network")
    with pytest.raises(KeyError, match="error/u/max"):
        Comparison.of({"a": [result(0.1, mean=1.0)]}, "error/u/max")
