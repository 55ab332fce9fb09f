"""Optuna's samplers and pruners, whose choices depend on seed and results alone."""

import csv
import importlib.util
import statistics
from pathlib import Path

import pytest

from physx_cluster.errors import StudyError
from physx_cluster.sweep import Definition, Result, run_study
from physx_cluster.sweep.optuna import OptunaSearch, Pruning
from physx_cluster.sweep.parameters import Choices, Range
from physx_cluster.sweep.plan import Plan
from physx_core.errors import ConfigError, MissingLibraryError

pytestmark = pytest.mark.processes

pytest.importorskip("optuna")

RANGES = {"lr": Range(1e-4, 1.0, log=True), "n": Range(1, 64), "kind": Choices(("a", "b"))}


def value(setting):
    return abs(setting["lr"] - 0.01) + setting["n"] / 64 + (setting["kind"] == "a")


def search(sampler="optuna/tpe", goal="minimize", **kwargs):
    return OptunaSearch(sampler, kwargs, RANGES, 3, goal)


def history(search, batches=8, size=3, sign=1):
    found = []
    for _ in range(batches):
        asked = search.ask(size)
        found += asked
        search.tell([[Result("complete", sign * value(setting), 1)] for setting in asked])
    return found


@pytest.mark.parametrize("name", ["tpe", "random", "qmc", "nsgaii", "cmaes"])
def test_the_same_questions_get_the_same_answers(name):
    if name == "cmaes":
        pytest.importorskip("cmaes")
    first, second = history(search(f"optuna/{name}")), history(search(f"optuna/{name}"))
    assert first == second
    assert len({setting["lr"] for setting in first}) > 20


def test_a_sampler_finds_good_settings_in_either_direction():
    for goal, sign in (("minimize", 1), ("maximize", -1)):
        found = [value(s) for s in history(search(goal=goal, n_startup_trials=6), 20, sign=sign)]
        assert statistics.median(found[-30:]) < statistics.median(found[:6]) / 3


def test_more_settings_leave_the_first_ones_as_they_are(write):
    def plan(trials):
        ranges = {"training.network.lr": {"low": 0.01, "high": 0.5}}
        file = write(sampler="optuna/tpe", trials=trials, batch=4, parameters=ranges)
        made, found = Plan(Definition.read(file)), []
        while batch := made.next_batch():
            found += batch
            made.tell(
                {t.number: Result("complete", t.values["training.network.lr"]) for t in batch}
            )
        return found

    short, long = plan(6), plan(15)
    assert long[:6] == short
    assert [trial.known for trial in short] == [0, 0, 0, 0, 4, 4]


def test_several_seeds_count_by_their_mean_and_failures_are_told():
    one, other = search(), search()
    for made in (one, other):
        made.ask(4)
    results = [Result("complete", 1.0), Result("complete", 3.0)]
    mean = [Result("complete", 2.0)]
    failed = [Result("failed"), Result("complete", 1.0)]
    pruned = [Result("pruned", 4.0, 1, numbers={1: 4.0}), Result("complete", 4.0, numbers={1: 4.0})]
    one.tell([results, failed, pruned, mean])
    other.tell([mean, [Result("failed")], [Result("pruned", 4.0, 1, numbers={1: 4.0})], mean])
    assert one.ask(20) == other.ask(20)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: search("optuna/tppe"), r'no sampler "optuna/tppe".*Did you mean "optuna/tpe"'),
        (lambda: search("optuna/grid"), 'no sampler "optuna/grid"'),
        (lambda: search(startup=3), 'has no option "startup"'),
        (lambda: search("optuna/qmc", qmc_type="holton"), "rejects its arguments"),
        (lambda: Pruning("optuna/medain", {}, "minimize", []), 'Did you mean "optuna/median"'),
        (lambda: Pruning("optuna/median", {"n": 3}, "minimize", []), 'has no option "n"'),
    ],
)
def test_unknown_names_and_arguments(call, text):
    with pytest.raises(ConfigError, match=text):
        call()


def test_a_sampler_or_pruner_that_does_not_exist_leaves_no_study(write):
    for options in ({"sampler": "tpe", "trials": 3}, {"pruner": "median"}):
        with pytest.raises(ConfigError, match="Did you mean"):
            run_study(Definition.read(write(**options)), Path("study"), print)
        assert not Path("study").exists()


EARLIER = [Result("complete", v, 4, numbers=dict(enumerate([v + 3, v + 2, v + 1, v], 1)))
           for v in (1.0, 2.0, 3.0)]  # fmt: skip


def decisions(pruner, kwargs, numbers, earlier, at_once=False, goal="minimize"):
    pruning = Pruning(pruner, kwargs, goal, earlier)
    if at_once:
        return pruning.decide(dict(enumerate(numbers, 1))), pruning.rungs
    found = [pruning.decide(dict(enumerate(numbers[:n], 1))) for n in range(1, len(numbers) + 1)]
    return found[-1], pruning.rungs


@pytest.mark.parametrize("name", ["median", "percentile", "successive_halving", "hyperband"])
def test_pruner_decides_the_same_after_resume(name):
    kwargs = {
        "median": {"n_startup_trials": 2},
        "percentile": {"percentile": 50.0, "n_startup_trials": 2},
        "successive_halving": {"min_resource": 1, "reduction_factor": 2},
        "hyperband": {"min_resource": 1, "max_resource": 8, "reduction_factor": 2},
    }[name]
    for numbers in ([9.0], [9.0, 8.5], [9.0, 8.5, 8.2], [1.0, 0.5, 0.2]):
        one_by_one = decisions(f"optuna/{name}", kwargs, numbers, EARLIER)
        assert one_by_one == decisions(f"optuna/{name}", kwargs, numbers, EARLIER, at_once=True)


def test_a_pruner_compares_with_earlier_trials_and_with_no_others():
    kwargs = {"n_startup_trials": 2}
    assert decisions("optuna/median", kwargs, [9.0], EARLIER)[0]
    assert not decisions("optuna/median", kwargs, [4.0], EARLIER)[0]
    assert not decisions("optuna/median", kwargs, [9.0], EARLIER, goal="maximize")[0]
    assert not decisions("optuna/median", kwargs, [9.0], [None, None, None])[0]
    unsound = [Result("failed", error="DivergedError"), None, EARLIER[0]]
    assert not decisions("optuna/median", kwargs, [9.0], unsound)[0]


def test_what_a_pruner_keeps_of_trials_is_passed_on():
    kwargs = {"min_resource": 1, "reduction_factor": 2}
    earlier = []
    for first in (1.0, 2.0, 3.0, 4.0):
        pruning = Pruning("optuna/successive_halving", kwargs, "minimize", earlier)
        ends = pruning.decide({1: first})
        earlier.append(
            Result("pruned" if ends else "complete", first, 1, "", {1: first}, pruning.rungs)
        )
    assert earlier[0].rungs == {"completed_rung_0": 1.0}
    assert [result.state for result in earlier] == ["complete", "pruned", "pruned", "pruned"]


@pytest.mark.slow
def test_trials_that_fall_behind_end_early(write):
    options = {"pruner": "optuna/median", "pruner_kwargs": {"n_startup_trials": 1}, "batch": 1}
    file = write(parameters={"training.network.lr": [0.05, 0.01, 0.2]}, **options)
    said = []
    study = run_study(Definition.read(file), Path("study"), said.append)
    with Path("study/trials.csv").open(newline="") as table:
        rows = list(csv.DictReader(table))
    assert [row["state"] for row in rows] == ["complete", "pruned", "complete"]
    assert int(rows[1]["epochs"]) < 4
    assert study.best().trials[0].number == 3
    assert any("pruned" in line for line in said)


def test_a_library_that_a_sampler_lacks_is_named_before_anything_runs(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingLibraryError, match=r'"optuna/cmaes" needs the package "cmaes"'):
        search("optuna/cmaes")


@pytest.mark.slow
def test_fewer_trials_in_a_batch_than_processes_are_said(write):
    options = {"sampler": "optuna/tpe", "trials": 2, "batch": 1, "run": {"parallel": 2}}
    said = []
    run_study(Definition.read(write(**options)), Path("study"), said.append)
    assert said[1].startswith("note: only 1 of 2 (run.parallel) trials can run at the same time")


@pytest.mark.slow
def test_results_that_were_changed_are_noticed(write):
    ranges = {"training.network.lr": {"low": 0.01, "high": 0.5}}
    options = {"sampler": "optuna/tpe", "sampler_kwargs": {"n_startup_trials": 1}}
    file = write(trials=3, batch=1, parameters=ranges, **options)
    run_study(Definition.read(file), Path("study"), lambda line: None)
    place = Path("study/trial_0002/result.toml")  # the better one of the first two
    changed = [
        line if not line.startswith("value") else "value = 7.5"
        for line in place.read_text().splitlines()
    ]
    place.write_text("\n".join(changed))
    with pytest.raises(StudyError, match="Its results were changed, or Optuna's version"):
        run_study(Definition.read(file), Path("study"), lambda line: None)
