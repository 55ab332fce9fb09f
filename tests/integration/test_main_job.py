"""One user script through generation, training and prediction, in process and with clients."""

import os
import signal
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from physx_core import Dataset

pytestmark = pytest.mark.processes

SCRIPT = """
import sys
import numpy as np
from physx_core import DataGeneration, Environment, EnvironmentConfig

class Walk(Environment):
    def create(self):
        self.x = np.zeros(3)
    def init_database(self):
        self.define_training_fields([("x", np.ndarray), ("dx", np.ndarray)])
    def step(self):
        dx = self.rng.standard_normal(3)
        self.set_training_data(x=self.x, dx=dx)
        self.x = self.x + dx

if __name__ == "__main__":
    clients, batches, name = sys.argv[1:]
    config = EnvironmentConfig(
        Walk, as_tcp_ip_client=clients.startswith("tcp"), num_clients=int(clients[-1]), seed=5
    )
    DataGeneration(config, batch_nb=int(batches), batch_size=101, session_name=name).execute()
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "walk.py"
    path.write_text(SCRIPT)
    return path


def rows_of(session):
    with Dataset.open(session) as dataset:
        return {name: dataset["training"][name][:] for name in dataset.fields("training")}


@pytest.mark.parametrize("number", [1, 2])
def test_the_same_rows_in_process_and_with_clients(number, script, run, tmp_path, processes):
    mark = f"{tmp_path}"
    for where in ("local", "tcp"):
        run(script, f"{where}{number}", 5, f"{where}{number}", PHYSX_TEST_MARK=mark)
        assert processes(f"PHYSX_TEST_MARK={mark}") == []
    local = rows_of(tmp_path / f"sessions/local{number}")
    clients = rows_of(tmp_path / f"sessions/tcp{number}")
    assert local.keys() == clients.keys() == {"x", "dx", "env_id", "episode", "step"}
    assert all(np.array_equal(local[name], clients[name]) for name in local)
    assert len(local["x"]) == 505


def test_h5py_the_virtual_index_and_dataset_show_the_same(script, run, tmp_path):
    run(script, "local1", 3, "run")
    rows = rows_of(tmp_path / "sessions/run")
    with h5py.File(tmp_path / "sessions/run/dataset/run.h5") as index:
        assert set(index["training"]) == set(rows)
        assert all(np.array_equal(index[f"training/{name}"][:], rows[name]) for name in rows)
    with h5py.File(tmp_path / "sessions/run/dataset/run_training_x_0.h5") as partition:
        assert np.array_equal(partition["data"][:], rows["x"])
        assert partition["rows"][()] == 303


def rows_in(path):
    with h5py.File(path) as partition:
        return int(partition["rows"][()])


@pytest.mark.parametrize("where", ["local1", "tcp2"])
def test_kill_9_loses_no_committed_row(where, script, run, tmp_path, processes):
    environment = {**os.environ, "PHYSX_TEST_MARK": f"{tmp_path}"}
    process = subprocess.Popen(
        [sys.executable, str(script), where, "1000000", "run"], cwd=tmp_path, env=environment
    )
    committed, deadline = 0, time.monotonic() + 60
    while committed < 3000 and time.monotonic() < deadline:
        time.sleep(0.1)
        # A row is committed once it is in all five fields, one after the other.
        files = list(tmp_path.glob("sessions/run/dataset/run_training_*_0.h5"))
        committed = min(map(rows_in, files)) if len(files) == 5 else 0
    process.send_signal(signal.SIGKILL)
    process.wait(60)
    rows = rows_of(tmp_path / "sessions/run")
    assert len(rows["x"]) >= committed >= 3000
    first = rows["env_id"] == 1
    x, dx = rows["x"][first], rows["dx"][first]
    assert np.array_equal(x[1:], (x + dx)[:-1])
    text = run("-m", "physx_core", "info", tmp_path / "sessions/run").stdout
    assert f"{len(rows['x']):,}" in text
    deadline = time.monotonic() + 60
    while processes(f"PHYSX_TEST_MARK={tmp_path}") and time.monotonic() < deadline:
        time.sleep(0.1)
    assert processes(f"PHYSX_TEST_MARK={tmp_path}") == []
