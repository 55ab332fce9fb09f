"""What tests of sweeps share: a dataset, and files that describe studies."""

import os
import subprocess
import sys
from pathlib import Path

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


def descent(data):
    """Return the table of a training by gradient descent, 8 batches in each of 4 epochs."""
    return {
        "epoch_nb": EPOCHS,
        "batch_size": 10,
        "dataset": {"existing_dir": str(data), "view": {"fold": 0}},
        "network": {
            "network": "toy/linear",
            "network_kwargs": {"net_fields": ["state", "force"]},
            "optimization": f"{PROGRAM}:Descent",
        },
    }


def write_study(path, training, *, parameters=None, pipelines=None, run=None, **study):
    plain = {
        "study": study,
        "run": run or {},
        "parameters": {"training.network.lr": [0.1, 0.3]} if parameters is None else parameters,
        "pipelines": pipelines or {"linear": {"training": training}},
    }
    Path(path).write_text(tomli_w.dumps(plain))
    return Path(path)


@pytest.fixture
def training(data):
    """The table of a training by gradient descent."""
    return descent(data)


@pytest.fixture
def write(training):
    """A function that writes a study's file; its options are those of the table [study]."""
    return lambda path="sweep.toml", **options: write_study(path, training, **options)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory, data):
    """A function that returns the folder of a study that ran to its end; pauses change nothing."""
    made = {}

    def run(**options):
        name = repr(options)
        if name not in made:
            folder = tmp_path_factory.mktemp("undisturbed")
            write_study(folder / "sweep.toml", descent(data), run={"parallel": 2}, **options)
            physx("sweep", folder / "sweep.toml", "--study", folder / "whole")
            made[name] = folder / "whole"
        return made[name]

    return run


@pytest.fixture
def whole(undisturbed):
    """A function that puts the study with some options, run to its end, into studies/whole."""

    def put(**options):
        Path("studies").mkdir()
        Path("studies/whole").symlink_to(undisturbed(**options))

    return put


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
