"""ClientSource: clients that exit, are killed, crash, cannot start, or leave something running.

What clients do to themselves at each place of their life is in `test_clients_faults_everywhere`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.errors import ClientError

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "worker_envs.py"
SOON = 30.0  # far below the time for which a client may be silent, on the busiest machine too


@pytest.mark.parametrize(("method", "rows"), [("__init__", 0), ("step", 3)])
def test_exit_of_environment_is_reported_with_client(clients, method, rows):
    kwargs = {"what": "leave", "method": method, "who": 2}
    with (
        pytest.raises(ClientError, match=f"Client 2 ended with exit status 5 after {rows} rows"),
        clients("Trouble", num_clients=3, env_kwargs=kwargs, run_ahead=0) as source,
    ):
        source.batch(9)
        source.batch(3)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_killed_client_is_reported_at_once(clients, process_ids, number):
    with (
        pytest.raises(
            ClientError, match=rf"Client 2 was killed by signal .*{number.name}"
        ) as caught,
        clients("Walk", num_clients=2, env_kwargs={"delay": 0.02}) as source,
    ):
        source.batch(4)
        timer = threading.Timer(0.1, os.kill, (process_ids()[2], number))
        timer.start()
        began = time.monotonic()
        while True:
            source.batch(2)
    assert time.monotonic() - began < SOON
    assert caught.value.exit_status == -number
    timer.join()


def test_client_that_cannot_start_is_reported_at_once(clients, monkeypatch, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "numpy.py").write_text("raise ImportError('numpy is broken today')\n")
    monkeypatch.setenv("PYTHONPATH", str(broken))
    began = time.monotonic()
    with pytest.raises(ClientError, match="before it connected") as caught, clients("Plain"):
        pass
    assert time.monotonic() - began < SOON
    assert caught.value.exit_status == 1
    assert "numpy is broken today" in caught.value.stderr


def test_crash_of_client_reports_location(clients):
    with (
        pytest.raises(ClientError, match=r"SIGSEGV") as caught,
        clients("Trouble", env_kwargs={"what": "crash"}) as source,
    ):
        source.batch(9)
    assert "in crash" in caught.value.stderr


def test_committed_rows_survive_client_crash(nothing_stays_behind):
    config = EnvironmentConfig(
        f"{ENVS}:Faulty", num_clients=2, env_kwargs={"fault": "kill", "place": "step", "at": 3000}
    )
    pipeline = DataGeneration(config, batch_nb=100, batch_size=100)
    with pytest.raises(ClientError, match="Client 2 was killed by signal 9"):
        pipeline.execute()
    with Dataset.open(pipeline.session.dataset_dir) as dataset:
        assert dataset.verify() == []
        count = dataset.num_samples("training")
        assert count == 100 * pipeline.batch_id
        assert count <= 6000
        if count:
            row = np.arange(count)
            assert np.array_equal(dataset["training"]["x"][:].T, [row % 2 + 1, row // 2])


def test_child_processes_of_environment_are_terminated(clients, tmp_path, monkeypatch):
    note = tmp_path / "child"
    monkeypatch.setenv("PHYSX_TEST_CHILD", str(note))
    with clients("Trouble", env_kwargs={"what": "leave_child", "method": "create"}) as source:
        source.batch(2)
        os.kill(int(note.read_text()), 0)


def test_error_of_the_run_terminates_clients_without_waiting(clients):
    began = time.monotonic()
    with (
        pytest.raises(KeyboardInterrupt),
        clients("Trouble", env_kwargs={"what": "sleep", "at": 2}) as source,
    ):
        source.batch(2)
        raise KeyboardInterrupt
    assert time.monotonic() - began < SOON


SERVER = """
from pathlib import Path
from physx_core.config import EnvironmentConfig
from physx_core.sources.client_source import ClientSource

kwargs = {{"fault": {fault!r}, "place": "step"}}
config = EnvironmentConfig({environment!r}, env_kwargs=kwargs, num_clients=2)
with ClientSource(config, None, [0]) as source:
    while True:
        source.batch(2)
        Path("ready").touch()
"""


@pytest.mark.parametrize("fault", ["nothing", "stop", "hold"])
def test_killed_server_leaves_no_client_process(nothing_stays_behind, fault):
    """Nor a client that is stopped, or in which no Python can run."""
    # Each of the two clients has a child of its own; the fixture looks for all four.
    Path("server.py").write_text(SERVER.format(environment=f"{ENVS}:Faulty", fault=fault))
    server = subprocess.Popen([sys.executable, "server.py"])
    deadline = time.monotonic() + 60
    while not Path("ready" if fault == "nothing" else "broke").exists():
        assert server.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    server.kill()
    assert server.wait() == -signal.SIGKILL
