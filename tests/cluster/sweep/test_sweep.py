"""``physx sweep``: pipelines, settings and seeds on this machine."""

import copy
import csv
import os
import re
import signal
from pathlib import Path

import pytest

from physx_cluster.errors import StudyError
from physx_cluster.sweep import Definition, Study, run_study
from physx_core import Dataset, NetworkConfig, Training, View
from physx_core.errors import ConfigError
from physx_core.views.dataset_config import DatasetConfig

pytestmark = pytest.mark.processes


def table(folder):
    with (Path(folder) / "trials.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_each_pipeline_is_tried_with_each_setting_and_seed(write, training, physx, data):
    other = copy.deepcopy(training)
    other["network"]["network_kwargs"]["net_fields"] = ["state"]
    pipelines = {"all": {"training": training}, "state": {"training": other}}
    write(pipelines=pipelines, seeds=[3, 4], run={"parallel": 2})
    said = physx("sweep", "sweep.toml")
    rows = table("studies/sweep")
    tried = [(r["pipeline"], r["training.network.lr"], r["seed"]) for r in rows]
    assert tried == [(p, lr, s) for lr in ("0.1", "0.3") for p in ("all", "state") for s in "34"]
    assert [row["trial"] for row in rows] == [str(number) for number in range(1, 9)]
    assert {row["state"] for row in rows} == {"complete"}
    assert {row["epochs"] for row in rows} == {"4"}
    assert "best*: all, lr 0.3: loss/validation" in said
    # A trial is what the same training is that nobody sweeps.
    network = NetworkConfig(**{**training["network"], "lr": 0.3})
    alone = Training(
        network,
        DatasetConfig(existing_dir=data, view=View(fold=0)),
        epoch_nb=4,
        batch_size=10,
        seed=4,
        quiet=True,
    )
    alone.execute()
    assert float(rows[5]["loss/validation"]) == alone.best.loss
    # The status is that of the table, and marks the best.
    status = physx("sweep", "--status", "studies/sweep")
    assert re.search(r"\*5  all +0\.3 +3  complete +4 +\S+  [▁-█]{4}\n", status)
    assert "trials: 8 complete" in status
    # Nothing is left to do, and nothing is done.
    before = {p: p.stat().st_mtime_ns for p in Path("studies").rglob("*/scalars.csv")}
    assert "8 of them done" in physx("sweep", "sweep.toml")
    assert before == {p: p.stat().st_mtime_ns for p in Path("studies").rglob("*/scalars.csv")}


@pytest.mark.slow
def test_more_trials_leave_the_first_ones_as_they_are(write, physx):
    ranges = {"training.network.lr": {"low": 0.05, "high": 0.4, "log": True}}
    write(sampler="random", trials=1, parameters=ranges)
    physx("sweep", "sweep.toml")
    before = Path("studies/sweep/trials.csv").read_text()
    write(sampler="random", trials=2, parameters=ranges)
    assert "1 of them done" in physx("sweep", "sweep.toml")
    after = Path("studies/sweep/trials.csv").read_text()
    assert after.startswith(before)
    assert len(after.splitlines()) == 3
    write(sampler="random", trials=2, parameters={"training.network.lr": [0.1]})
    said = physx("sweep", "sweep.toml", status=1)
    assert "parameters.training.network.lr was None and is [0.1]" in said
    assert Path("studies/sweep/trials.csv").read_text() == after


@pytest.mark.slow
def test_trials_that_fail_are_results_and_the_others_go_on(write, physx):
    write(parameters={"training.network.lr": [0.123, 1e6, 0.3]})
    said = physx("sweep", "sweep.toml")
    refused, diverged, sound = table("studies/sweep")
    assert (refused["state"], refused["error"]) == ("failed", "ConfigError")
    assert (diverged["state"], diverged["error"]) == ("failed", "DivergedError")
    assert sound["state"] == "complete"
    assert "This rate is of no use" in said
    status = physx("sweep", "--status", "studies/sweep")
    assert "trials: 2 failed, 1 complete" in status
    assert "*3" in status


def test_a_study_in_which_nothing_succeeds_is_an_error(write, physx):
    write(parameters={"training.network.lr": [0.123]})
    said = physx("sweep", "sweep.toml", status=1)
    assert "No trial of studies/sweep is complete" in said
    assert table("studies/sweep")[0]["state"] == "failed"


@pytest.mark.slow
def test_what_concerns_all_trials_ends_the_sweep_at_once_and_is_no_result(write, training, physx):
    away = Path("away")
    training["dataset"]["existing_dir"] = "data"
    write()
    said = physx("sweep", "sweep.toml", status=1)
    assert "DatasetNotFoundError: There is no dataset in data" in said
    assert "the same command resumes" in said
    assert table("studies/sweep") == []
    assert not Path("studies/sweep/trial_0002/output.txt").exists()
    status = physx("sweep", "--status", "studies/sweep")
    assert "trials: 2 without a result" in status
    assert not away.exists()


def test_a_number_that_trainings_do_not_record_is_named(write, physx):
    write(result="loss/validatoin")
    said = physx("sweep", "sweep.toml", status=1)
    assert 'do not record "loss/validatoin"' in said
    assert 'Did you mean "loss/validation"?' in said


@pytest.mark.slow
def test_each_trial_may_generate_its_own_data(write, training, physx):
    del training["dataset"]["existing_dir"]
    spring = {"environment": "toy/spring", "as_tcp_ip_client": False}
    generation = {"batch_nb": 5, "batch_size": 20, "environment": spring}
    pipelines = {"own": {"data_generation": generation, "training": training}}
    stiff = {"data_generation.environment.env_kwargs.stiffness": [10.0, 30.0]}
    write(pipelines=pipelines, parameters=stiff, seeds=[7], run={"parallel": 2})
    physx("sweep", "sweep.toml")
    assert [row["state"] for row in table("studies/sweep")] == ["complete"] * 2
    for number, stiffness in ((1, 10.0), (2, 30.0)):
        with Dataset.open(f"studies/sweep/trial_000{number}") as dataset:
            assert dataset.num_samples("training") == 100
            assert dataset.info["env_kwargs"] == {"stiffness": stiffness}
            assert dataset.info["seed"] == 7


def test_two_sweeps_do_not_share_a_folder(write):
    definition = Definition.read(write())
    with Study.open(Path("study"), definition), pytest.raises(StudyError, match="Another sweep"):
        Study.open(Path("study"), definition)
    Study.open(Path("study"), definition).close()


def test_a_process_forked_during_a_sweep_does_not_keep_its_folder(write):
    definition = Definition.read(write())
    with Study.open(Path("study"), definition):
        sleeper = os.fork()
        if not sleeper:
            signal.pause()
    try:
        Study.open(Path("study"), definition).close()
    finally:
        os.kill(sleeper, signal.SIGKILL)
        os.waitpid(sleeper, 0)


def test_a_folder_that_is_no_study_is_named(physx):
    Path("empty").mkdir()
    assert "There is no study in empty" in physx("sweep", "empty", "--status", status=1)
    assert "There is no configuration file" in physx("sweep", "missing.toml", status=1)


@pytest.mark.slow
def test_corrupt_trial_files_are_reported(write):
    definition = Definition.read(write(parameters={"training.network.lr": [0.1]}))
    folder = Path("study")
    run_study(definition, folder, lambda line: None)
    before = (folder / "trials.csv").read_bytes()
    (folder / "trial_0001/result.toml").write_text("state = 'great'")
    with pytest.raises(StudyError, match=r"result.toml is damaged .* Remove it"):
        Study.read(folder)
    (folder / "trial_0001/result.toml").unlink()
    run_study(definition, folder, lambda line: None)
    assert (folder / "trials.csv").read_bytes() == before
    (folder / "trial_0001/trial.toml").write_text("[trial]\nnumber = 2")
    with pytest.raises(StudyError, match=r"trial.toml is damaged"):
        Study.read(folder)


def test_options_that_the_sweep_chooses_are_refused(write, training):
    training["session_name"] = "mine"
    with pytest.raises(ConfigError, match="session_name is chosen by the sweep"):
        Definition.read(write())
