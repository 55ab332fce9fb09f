"""What tests of sweeps share: a dataset, and files that describe studies."""

import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import tomli_w

from physx_core import DataGeneration, EnvironmentConfig

PROGRAM = Path(__file__).parents[1] / "programs" / "descent.py"
EPOCHS, BATCHES = 4, 8


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Studies are relative to the working directory: each test has its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    """The folder of a dataset with 100 samples, of which trainings hold 20 back."""
    folder = tmp_path_factory.mktemp("data")
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=1)
    run = DataGeneration(
        spring, session_dir=str(folder), session_name="run", batch_nb=5, batch_size=20, quiet=True
    )
    run.execute()
    return run.session.path


@pytest.fixture
def training(data):
    """The table of a training by gradient descent, 8 batches in each of 4 epochs."""
    return {
        "epoch_nb": EPOCHS,
        "batch_size": 10,
        "dataset": {"existing_dir": str(data), "validation_split": 0.2},
        "network": {
            "network": "toy/linear",
            "network_kwargs": {"net_fields": ["state", "force"]},
            "optimization": f"{PROGRAM}:Descent",
        },
    }


@pytest.fixture
def write(training):
    """A function that writes a study's file; its options are those of the table [study]."""

    def write(path="sweep.toml", *, parameters=None, pipelines=None, run=None, **study):
        plain = {
            "study": study,
            "run": run or {},
            "parameters": {"training.network.lr": [0.1, 0.3]} if parameters is None else parameters,
            "pipelines": pipelines or {"linear": {"training": training}},
        }
        Path(path).write_text(tomli_w.dumps(plain))
        return Path(path)

    return write


def physx(*words, status=0, **variables):
    """Run a command; return what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "physx_core.cli", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=200,
        env={**os.environ, **variables},
    )
    assert done.returncode == status, done.stderr
    return done.stdout + done.stderr


@pytest.fixture(name="physx")
def run_physx():
    """The function that runs a command."""
    return physx


@pytest.fixture
def parameters_of():
    """A function that returns the bytes of a study's final parameters, by trial."""

    def parameters(study):
        found = {}
        for trial in sorted(Path(study).glob("trial_*/")):
            numbers = [int(p.name.rpartition("_")[2]) for p in trial.glob("network/network_[0-9]*")]
            last = trial / "network" / f"network_{max(numbers)}"
            found[trial.name] = (last / "parameters.npz").read_bytes()
        return found

    return parameters
