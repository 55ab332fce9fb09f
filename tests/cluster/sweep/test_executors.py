"""The same study on Ray and by submitit: the same table."""

import os
import signal
import time
from pathlib import Path

import pytest
from one_node_slurm import wait_for
from sweep_kills import processes, start

pytestmark = [
    pytest.mark.usefixtures("nothing_stays_behind"),
    pytest.mark.slow,
    pytest.mark.processes,
]


@pytest.fixture
def idle_slurm(slurm, monkeypatch):
    """Slurm with this machine as its only node, where no job is left."""
    monkeypatch.setenv("SLURM_CONF", slurm.variables["SLURM_CONF"])
    assert wait_for(lambda: not slurm.ask("squeue", "--noheader"))
    return slurm


@pytest.fixture
def same_as_whole(whole, parameters_of):
    """A function that checks that a study on a cluster is the same as one here."""
    whole()

    def check(study="studies/there"):
        table = Path("studies/whole/trials.csv").read_bytes()
        assert Path(study, "trials.csv").read_bytes() == table
        assert parameters_of(study) == parameters_of("studies/whole")

    return check


@pytest.fixture
def slow(training):
    """A training whose batches take 5 ms at least, so that kills meet it."""
    training["network"]["optimization_kwargs"] = {"pause": 0.005}


def kill_one(study, deadline=120, *, parent=False):
    """Kill the process of a trial, or the one that started it, once it has a checkpoint."""
    end = time.monotonic() + deadline
    while time.monotonic() < end:
        for name, pid in processes(study).items():
            if list(Path(study, name).glob("network/*/checkpoint.toml")):
                stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                os.kill(int(stat[1]) if parent else pid, signal.SIGKILL)
                return
        time.sleep(0.02)
    pytest.fail("no trial has come to a checkpoint")


@pytest.mark.parametrize(
    ("executor", "options"),
    [
        pytest.param("ray", {"num_cpus": 1, "address": "local"}, marks=pytest.mark.faults),
        ("slurm", {"cluster": "local"}),
    ],
)
def test_the_table_is_the_same_wherever_trials_run(write, slow, same_as_whole, executor, options):
    pytest.importorskip({"ray": "ray", "slurm": "submitit"}[executor])
    write(run={"parallel": 2, "executor": executor, "options": options})
    sweep = start("sweep.toml", "studies/there")
    kill_one("studies/there")
    assert sweep.wait(200) == 0
    same_as_whole()


@pytest.mark.parametrize(
    ("executor", "options", "texts"),
    [
        ("local", {"cpus": 2}, ['The executor "local" has no option "cpus"']),
        ("ray", {"address": "of the tests", "cpus": 2}, ["Ray rejects the options", "cpus"]),
        ("ray", {"address": "127.0.0.1:9"}, ["Ray does not answer at 127.0.0.1:9"]),
        ("slurm", {"cluster": "local", "tiem": 3}, ["submitit rejects the options", "tiem"]),
        ("slurm", {"cluster": "slrm"}, ["run.options.cluster is 'slrm'"]),
    ],
)
def test_options_that_an_executor_does_not_know(
    write, physx, executor, options, texts, ray_cluster
):
    pytest.importorskip({"ray": "ray", "slurm": "submitit"}.get(executor, "physx_core"))
    if options.get("address") == "of the tests":
        options = {**options, "address": ray_cluster.variables["RAY_ADDRESS"]}
    write(run={"executor": executor, "options": options})
    said = physx("sweep", "sweep.toml", status=1)
    for text in texts:
        assert text in said


@pytest.mark.parametrize(
    ("executor", "options"),
    [
        pytest.param(
            "ray", {"num_cpus": 1, "address": "local"}, marks=pytest.mark.faults, id="ray"
        ),
        pytest.param("slurm", {"cluster": "local"}, id="slurm"),
    ],
)
def test_signal_to_sweep_terminates_trials(write, training, executor, options):
    pytest.importorskip({"ray": "ray", "slurm": "submitit"}[executor])
    training["network"]["optimization_kwargs"] = {"pause": 0.2}
    write(run={"executor": executor, "options": options})
    sweep = start("sweep.toml", "studies/there")
    deadline = time.monotonic() + 120
    while not list(Path("studies").glob("there/*.batches")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    sweep.send_signal(signal.SIGINT)
    assert sweep.wait(60) == 130
    deadline = time.monotonic() + 30
    while processes("studies/there"):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    if executor == "ray":  # the trial was asked to write a checkpoint
        assert list(Path("studies/there").glob("trial_0001/network/*/checkpoint.toml"))


@pytest.mark.faults
def test_killed_sweep_cancels_slurm_trials(write, slow, same_as_whole, idle_slurm):
    pytest.importorskip("submitit")
    write(run={"parallel": 2, "executor": "slurm"})
    sweep = start("sweep.toml", "studies/there")
    kill_one("studies/there")
    sweep.kill()
    sweep.wait()
    deadline = time.monotonic() + 60
    while processes("studies/there") or idle_slurm.ask("squeue", "--noheader"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert start("sweep.toml", "studies/there").wait(200) == 0
    same_as_whole()


@pytest.mark.faults
def test_preempted_slurm_trial_resumes(write, training, same_as_whole, idle_slurm):
    pytest.importorskip("submitit")
    training["network"]["optimization_kwargs"] = {"pause": 0.15}
    write(run={"parallel": 1, "executor": "slurm", "options": {"slurm_partition": "low"}})
    sweep = start("sweep.toml", "studies/there")
    deadline = time.monotonic() + 60
    while not list(Path("studies").glob("there/trial_0001/network/*/checkpoint.toml")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    idle_slurm.ask("sbatch", "-phigh", "-n4", "--output=/dev/null", "--wrap=sleep 1")
    assert sweep.wait(200) == 0
    same_as_whole()
    output = Path("studies/there/trial_0001/output.txt").read_text()
    assert output.count("session: ") == 2  # the same trial began twice


@pytest.mark.faults
def test_lost_ray_worker_of_sweep_is_restarted(write, slow, same_as_whole, ray_cluster):
    write(run={"executor": "ray", "options": {"address": ray_cluster.variables["RAY_ADDRESS"]}})
    sweep = start("sweep.toml", "studies/there")
    kill_one("studies/there", parent=True)
    assert sweep.wait(200) == 0
    same_as_whole()


def test_a_job_that_slurm_cannot_run_ends_the_sweep(write, physx, idle_slurm):
    pytest.importorskip("submitit")
    for options, text in (
        ({"slurm_partition": "none"}, "Slurm rejects the job of a trial"),
        ({"timeout_min": 600}, "Slurm"),
    ):
        write(run={"executor": "slurm", "options": options})
        assert text in physx("sweep", "sweep.toml", status=1)
        assert not idle_slurm.ask("squeue", "--noheader")


def test_without_slurm_the_sweep_says_so(write, physx):
    pytest.importorskip("submitit")
    write(run={"executor": "slurm"})
    said = physx("sweep", "sweep.toml", status=1, PATH="/nowhere")
    assert "Slurm does not answer" in said
