"""Clients as jobs of Slurm, and of submitit's local executor, which stands in for it."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from one_node_slurm import wait_for

pytest.importorskip("submitit")

from physx_cluster import SlurmLauncher
from physx_core.errors import ConfigError

pytestmark = [pytest.mark.slow, pytest.mark.processes]

TOKEN = "a token that nobody sees"


def slurm_words(*kwargs):
    """Return the words of a run whose clients are jobs."""
    more = ("--environment.launcher-kwargs", *kwargs) if kwargs else ()
    return ("--environment.launcher", "cluster/slurm", *more)


LOCAL = slurm_words("cluster='local'")


def jobs_of(folder):
    """Return the processes that submitit started for the jobs of runs in a folder."""
    found = []
    for entry in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*")):
        try:
            command = entry.read_bytes()
        except OSError:
            continue
        if b"submitit.core._submit" in command and f"{folder}/.physx".encode() in command:
            found.append(int(entry.parent.name))
    return found


# Processes of this machine ----------------------------------------------------------------------


def test_local_jobs_make_the_rows_of_a_local_run(runs, local_rows, eventually):
    """The name of their folder is not taken for one of their processes."""
    expected = local_rows()
    (runs.folder / "submitit").mkdir()
    words = slurm_words("cluster='local'", "folder='submitit'")
    assert runs.same(runs.rows(*words), expected)
    assert not list((runs.folder / "submitit").iterdir())
    assert "submitit" not in runs.log.read_text()
    eventually(runs.nothing_is_left)


@pytest.mark.faults
def test_preempted_local_job_is_requeued_with_same_rows(runs, local_rows, eventually):
    expected = local_rows(batches=20)
    words = (*LOCAL, "--environment.retries", "1")
    process = runs.start(*words, batches=20, pace=0.05)
    runs.wait_for_clients(2, process)
    jobs = jobs_of(runs.folder)
    assert len(jobs) == 2
    os.kill(jobs[0], signal.SIGUSR2)  # as Slurm announces a preemption to submitit's jobs
    status, said = runs.finish(process)
    assert status == 0, said
    assert "Restart 1 of 1" in said
    assert "Slurm interrupted and requeued job" in said
    assert runs.same(runs.stored(), expected)
    eventually(runs.nothing_is_left)


@pytest.mark.parametrize("way", ["error", "SIGINT", "SIGKILL"])
def test_signals_and_errors_leave_no_local_job(way, runs, eventually):
    process = runs.start(*LOCAL, batches=10_000, pace=0.01, fail_at=5 if way == "error" else -1)
    runs.wait_for_clients(2, process)
    if way != "error":
        process.send_signal(getattr(signal, way))
    status, said = runs.finish(process)
    assert status != 0
    assert ("on purpose" in said) == (way == "error")
    eventually(runs.nothing_is_left)
    eventually(lambda: not jobs_of(runs.folder))


# Slurm ------------------------------------------------------------------------------------------


def test_jobs_make_the_rows_of_a_local_run(runs, local_rows, slurm, eventually):
    expected = local_rows()
    assert runs.same(runs.rows(*slurm_words(), **slurm.variables), expected)
    assert len({node for *_, node in runs.clients()} - {"here"}) == 2  # two jobs
    eventually(runs.nothing_is_left)
    assert not slurm.ask("squeue", "--noheader")


def test_token_of_slurm_jobs_has_owner_only_permissions(runs, slurm):
    variables = {**slurm.variables, "PHYSX_TOKEN": TOKEN}
    process = runs.start(*slurm_words(), batches=10_000, pace=0.01, **variables)
    try:
        runs.wait_for_clients(2, process)
        [folder] = runs.folder.glob(".physx-*")
        assert not folder.stat().st_mode & 0o077
        holders = [path for path in folder.rglob("*") if path.is_file() and holds_token(path)]
        assert holders == [folder / "token"]
        assert not holders[0].stat().st_mode & 0o077
        assert list(folder.glob("*_submitted.pkl"))
        assert not list(filter(holds_token, slurm.folder.rglob("*")))
        assert not [
            path
            for path in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*"))
            if holds_token(path)
        ]
    finally:
        process.send_signal(signal.SIGINT)
        runs.finish(process)


def holds_token(path):
    try:
        return TOKEN.encode() in path.read_bytes()
    except OSError:
        return False


@pytest.mark.faults
def test_preempted_slurm_job_is_requeued_with_same_rows(runs, local_rows, slurm, eventually):
    expected = local_rows(batches=20)
    words = slurm_words("slurm_partition='low'")
    process = runs.start(
        *words, "--environment.retries", "1", batches=20, pace=0.05, **slurm.variables
    )
    runs.wait_for_clients(2, process)
    before = {node for *_, node in runs.clients()}
    others = slurm.ask("sbatch", "-phigh", "-n4", "--output=/dev/null", "--wrap=sleep 2")
    assert "Submitted" in others
    pending = ("squeue", "--array", "--noheader", "--states=PENDING", "-plow", "--format=%i")
    eventually(lambda: len(slurm.ask(*pending).split()) == 2)
    for job in slurm.ask(*pending).split():
        slurm.ask("scontrol", "update", f"JobId={job}", "StartTime=now")  # not in two minutes
    status, said = runs.finish(process)
    assert status == 0, said
    assert "Restart 1 of 1" in said
    assert runs.same(runs.stored(), expected)
    assert {node for *_, node in runs.clients()} == before  # the same jobs
    eventually(runs.nothing_is_left)
    assert not slurm.ask("squeue", "--noheader")


@pytest.mark.parametrize("way", ["error", "SIGINT", "SIGTERM", "SIGKILL"])
def test_signals_and_errors_cancel_slurm_jobs(way, runs, slurm, eventually):
    fail_at = 5 if way == "error" else -1
    process = runs.start(
        *slurm_words(), batches=10_000, pace=0.01, fail_at=fail_at, **slurm.variables
    )
    runs.wait_for_clients(2, process)
    if way != "error":
        process.send_signal(getattr(signal, way))
    status, said = runs.finish(process)
    assert status != 0
    assert ("on purpose" in said) == (way == "error")
    eventually(runs.nothing_is_left)
    eventually(lambda: not slurm.ask("squeue", "--noheader"))


@pytest.fixture
def busy(slurm):
    """Slurm whose node has another job on all processors."""
    job = slurm.ask("sbatch", "-phigh", "-n4", "--output=/dev/null", "--wrap=sleep 1000").split()[
        -1
    ]
    assert wait_for(lambda: "RUNNING" in slurm.ask("squeue", "--noheader", "--format=%T"))
    yield slurm
    slurm.ask("scancel", job)
    assert wait_for(lambda: not slurm.ask("squeue", "--noheader"))


def test_killed_run_cancels_queued_slurm_jobs(runs, busy, eventually):
    process = runs.start(*slurm_words(), **busy.variables)
    eventually(lambda: "PENDING (Resources)" in " ".join(runs.log.read_text().split()))
    process.kill()
    process.wait()
    eventually(lambda: busy.ask("squeue", "--noheader", "--format=%P") == "high\n")
    eventually(runs.nothing_is_left)


@pytest.mark.faults
def test_queue_time_limit_of_slurm_job(runs, busy):
    status, said = runs.finish(runs.start(*slurm_words("queue_time=2"), **busy.variables))
    assert status == 1
    assert "for longer than queue_time, 2 s" in " ".join(said.split())


@pytest.mark.parametrize(
    ("kwargs", "text"),
    [
        (["mem_gb=999"], "was refused by Slurm: sbatch: error: Memory specification"),
        (["cpus_per_task=99"], "cannot give job"),
        (["slurm_partition='west'"], "invalid partition"),
    ],
)
def test_what_cannot_be_had_is_said_within_seconds(kwargs, text, runs, slurm, eventually):
    status, said = runs.finish(runs.start(*slurm_words(*kwargs), **slurm.variables), 60)
    assert status == 1
    assert text in " ".join(said.split())
    assert not runs.clients()
    eventually(runs.nothing_is_left)


def test_where_there_is_no_slurm_the_run_says_what_to_do(runs):
    status, said = runs.finish(runs.start(*slurm_words(), SLURM_CONF="/nonexistent"), 60)
    assert status == 1
    assert "Slurm does not answer" in said
    assert 'launcher_kwargs={"cluster": "local"}' in " ".join(said.split())


def test_job_unknown_to_slurm_counts_as_completed(slurm, tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_CONF", slurm.variables["SLURM_CONF"])
    launcher = SlurmLauncher(folder=str(tmp_path))
    launcher.open()
    try:
        state = launcher.state_of(SimpleNamespace(job_id="999999"), 0.0)
        assert (state.name, state.is_over, state.is_queued) == ("COMPLETED", True, False)
    finally:
        launcher.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.faults
def test_squeue_is_polled_rarely_for_all_jobs(runs, slurm, tmp_path):
    asked = tmp_path / "bin"
    asked.mkdir()
    program = asked / "squeue"
    program.write_text(f'#!/bin/sh\necho "$@" >>{tmp_path}/asked\nexec /usr/bin/squeue "$@"\n')
    program.chmod(0o755)
    path = {"PATH": f"{asked}:{os.environ['PATH']}"}
    process = runs.start(*slurm_words(), batches=10_000, pace=0.01, **slurm.variables, **path)
    runs.wait_for_clients(2, process)
    time.sleep(1)
    before = len((tmp_path / "asked").read_text().splitlines())
    time.sleep(6)
    after = len((tmp_path / "asked").read_text().splitlines())
    process.send_signal(signal.SIGINT)
    runs.finish(process)
    assert after - before <= 2


@pytest.mark.parametrize(
    ("kwargs", "text"),
    [
        ({"cluster": "slrum"}, 'cluster is \'slrum\', but must be "slurm" or "local"'),
        ({"nods": 3}, "Parameter 'nods' need to be prefixed"),
        ({"cluster": "local", "tiem": 3}, "tiem"),
        ({"folder": "/nonexistent"}, "Cannot create the jobs' folder in /nonexistent"),
    ],
)
def test_options_are_checked_before_anything_is_started(
    kwargs, text, slurm, tmp_path, monkeypatch, children
):
    monkeypatch.setenv("SLURM_CONF", slurm.variables["SLURM_CONF"])
    before = children()
    with pytest.raises(ConfigError, match=text):
        SlurmLauncher(**{"folder": str(tmp_path), **kwargs}).open()
    assert children() <= before
    assert not list(tmp_path.iterdir())


@pytest.mark.faults
def test_clients_of_a_campaign_are_jobs(runs, local_rows, eventually, trips):
    expected = local_rows(program=trips)
    options = {"clients": 4, "program": trips}
    assert runs.same(runs.rows(*LOCAL, "--environment.min-clients", "1", **options), expected)
    eventually(runs.nothing_is_left)
