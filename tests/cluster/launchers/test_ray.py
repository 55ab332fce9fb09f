"""Clients on Ray: the rows of a local run, whatever is lost, and nothing left on any node."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

pytest.importorskip("ray")

from physx_cluster import RayLauncher
from physx_core.errors import ClientError, ConfigError

pytestmark = [pytest.mark.slow, pytest.mark.processes]

RAY = ("--environment.launcher", "cluster/ray")
KWARGS = "--environment.launcher-kwargs"


def on(cluster, *kwargs):
    """Return the words and variables of a run on a cluster."""
    return (*RAY, *((KWARGS, *kwargs) if kwargs else ()))


def test_the_rows_are_those_of_a_local_run(runs, local_rows, ray_cluster, eventually):
    expected = local_rows()
    assert runs.same(runs.rows(*on(ray_cluster), **ray_cluster.variables), expected)
    nodes = sorted(node for *_, node in runs.clients())
    assert nodes == sorted(["here", str(ray_cluster.raylet_of(ray_cluster.nodes[1]))])
    busy = ("The run waits for", "The run has been waiting for")  # on a busy machine
    passing = ("batches", *busy)
    said = [
        line.partition(":")[0]
        for line in runs.log.read_text().splitlines()
        if not any(each in line for each in passing)
    ]
    assert said == ["session", "samples", "next", "next"]
    eventually(runs.nothing_is_left)


@pytest.mark.faults
def test_killed_ray_node_restarts_client_with_same_rows(runs, local_rows, ray_cluster, eventually):
    expected = local_rows(batches=20)
    lost = ray_cluster.nodes.pop()
    process = runs.start(
        *on(ray_cluster, "num_cpus=0.5"),
        *("--environment.retries", "1"),
        batches=20,
        pace=0.05,
        **ray_cluster.variables,
    )
    runs.wait_for_clients(2, process)
    time.sleep(1)
    ray_cluster.kill(lost)
    status, said = runs.finish(process)
    ray_cluster.nodes.append(ray_cluster.add_node())
    assert status == 0, said
    assert "Restart 1 of 1" in said
    assert runs.same(runs.stored(), expected)
    assert len(runs.clients()) == 3
    eventually(runs.nothing_is_left)


@pytest.mark.faults
def test_campaign_on_ray_survives_lost_node(runs, local_rows, ray_cluster, eventually, trips):
    """Of four clients two find a place, of which one is lost with its node."""
    expected = local_rows(batches=30, program=trips)
    lost = ray_cluster.nodes.pop()
    hold = runs.folder / "hold"  # else the first client may be done before there is a second
    hold.touch()
    process = runs.start(
        *on(ray_cluster, "num_cpus=1"),
        *("--environment.min-clients", "1"),
        clients=4,
        batches=30,
        pace=0.05,
        program=trips,
        **ray_cluster.variables,
    )
    node = str(ray_cluster.raylet_of(lost))
    eventually(lambda: node in {there for *_, there in runs.clients()}, 90)
    hold.unlink()
    time.sleep(1)
    ray_cluster.kill(lost)
    status, said = runs.finish(process)
    ray_cluster.nodes.append(ray_cluster.add_node())
    assert status == 0, said
    assert "Its episode is simulated once more" in said
    assert runs.same(runs.stored(), expected)
    eventually(runs.nothing_is_left)


@pytest.mark.faults
def test_run_survives_crash_of_ray_head(runs, local_rows, mortal_ray, eventually):
    expected = local_rows(batches=30)
    process = runs.start(*on(mortal_ray), batches=30, pace=0.1, **mortal_ray.variables)
    runs.wait_for_clients(2, process)
    time.sleep(1)
    mortal_ray.kill_head()
    status, said = runs.finish(process)
    assert status == 0, said
    assert "Ray is lost" in said
    assert "starts no more" in said
    assert runs.same(runs.stored(), expected)
    assert len(runs.clients()) == 2
    assert len({node for *_, node in runs.clients()}) == 2
    eventually(runs.nothing_is_left)


@pytest.mark.faults
def test_no_restart_without_ray_head(runs, mortal_ray, eventually):
    process = runs.start(
        *on(mortal_ray),
        "--environment.retries",
        "2",
        batches=1000,
        pace=0.1,
        **mortal_ray.variables,
    )
    runs.wait_for_clients(2, process)
    mortal_ray.kill_head()
    eventually(lambda: "Ray is lost" in runs.log.read_text(), 60)
    os.kill(int(runs.clients()[0][1]), signal.SIGKILL)
    status, said = runs.finish(process)
    assert status == 1
    assert "cannot be started: Ray is lost" in " ".join(said.split())
    eventually(runs.nothing_is_left)


def test_a_run_does_not_import_ray(ray_cluster, tmp_path):
    code = """
import sys
from physx_core import DataGeneration, EnvironmentConfig
environment = EnvironmentConfig("toy/spring", launcher="cluster/ray", num_clients=2, seed=0)
DataGeneration(environment, batch_nb=1, batch_size=4, quiet=True).execute()
sys.exit("ray" in sys.modules)
"""
    variables = {**os.environ, **ray_cluster.variables}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=variables)


@pytest.mark.parametrize(
    "way", ["error", pytest.param("SIGINT", marks=pytest.mark.faults), "SIGTERM", "SIGKILL"]
)
def test_signals_and_errors_leave_no_process_on_ray_nodes(way, runs, ray_cluster, eventually):
    fail_at = 5 if way == "error" else -1
    process = runs.start(
        *on(ray_cluster), batches=10_000, pace=0.01, fail_at=fail_at, **ray_cluster.variables
    )
    runs.wait_for_clients(2, process)
    if way != "error":
        process.send_signal(getattr(signal, way))
    status, said = runs.finish(process)
    assert status != 0, said
    eventually(runs.nothing_is_left)
    if way == "error":
        assert "on purpose" in said
    eventually(lambda: not any(b"ray::Agent" in command for command in commands()))


@pytest.mark.faults
def test_local_ray_cluster_ends_with_run(runs, eventually):
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")
    try:
        for way in ("return", "SIGKILL"):
            forever = 4 if way == "return" else 10_000
            process = runs.start(*RAY, batches=forever, pace=0.01, RAY_TMPDIR=folder)
            runs.wait_for_clients(2 if way == "return" else 4, process)
            if way == "SIGKILL":
                process.kill()
            status, said = runs.finish(process)
            assert status == (0 if way == "return" else -signal.SIGKILL), said
            eventually(runs.nothing_is_left)
            eventually(lambda: not any(folder.encode() in command for command in commands()))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def test_what_cannot_be_had_is_said_within_seconds(runs, ray_cluster):
    began = time.monotonic()
    process = runs.start(*on(ray_cluster, "num_gpus=3"), **ray_cluster.variables)
    status, said = runs.finish(process, 60)
    assert status == 1
    text = "a client needs 1 CPU and 3 GPU on one node, and nodes have at most"
    assert text in " ".join(said.split())
    assert time.monotonic() - began < 60
    assert not runs.clients()


@pytest.mark.parametrize(
    ("kwargs", "text"),
    [
        ({"num_cpus": 1.5}, "has no place on Ray"),
        ({"strategy": "STRICT_PACK"}, "2 clients, each with 1 CPU, do not fit the 2 nodes"),
    ],
)
def test_resources_beyond_ray_cluster_are_refused(kwargs, text, ray_cluster):
    launcher = RayLauncher(address=ray_cluster.variables["RAY_ADDRESS"], **kwargs)
    launcher.open()
    try:
        with pytest.raises(ClientError, match=text):
            launcher.launch([1, 2], "127.0.0.1:1", "token")
    finally:
        launcher.close()


@pytest.mark.parametrize(
    ("kwargs", "text"),
    [
        ({"strategy": "AROUND"}, "strategy is 'AROUND', but must be one of"),
        ({"num_cpus": 0}, "at least one resource"),
        ({"address": "ray://127.0.0.1:10001"}, "address of a Ray Client"),
        ({"address": "127.0.0.1:1"}, "Ray does not answer at 127.0.0.1:1"),
    ],
)
def test_options_are_checked_before_anything_is_started(kwargs, text):
    with pytest.raises(ConfigError, match=text):
        RayLauncher(**kwargs).open()


@pytest.mark.faults
def test_run_reports_queued_ray_clients(runs, ray_cluster, eventually):
    first = runs.start(*on(ray_cluster), batches=10_000, pace=0.01, **ray_cluster.variables)
    runs.wait_for_clients(2, first)
    log, runs.log = runs.log, runs.folder / "second"
    kwargs = on(ray_cluster, "num_cpus=1")
    second = runs.start(*kwargs, batches=2, **ray_cluster.variables)
    said = "2 of them: waiting for 1 CPU (Ray has 0 CPU free)"
    eventually(lambda: said in " ".join(runs.log.read_text().split()), 60)
    first.send_signal(signal.SIGINT)
    status, said = runs.finish(second)
    assert status == 0, said
    runs.log = log
    runs.finish(first)


@pytest.mark.faults
def test_more_clients_than_processors_share_them(runs, local_rows, ray_cluster):
    expected = local_rows(clients=5)
    assert runs.same(runs.rows(*on(ray_cluster), clients=5, **ray_cluster.variables), expected)


def commands():
    found = []
    for path in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*")):
        try:
            found.append(path.read_bytes())
        except OSError:
            continue
    return found
