"""A training that was interrupted goes on bit for bit."""

import dataclasses
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import Dataset, DatasetConfig, EnvironmentConfig, NetworkConfig, Training
from physx_core.cli import main
from physx_core.errors import CheckpointError, ConfigError, SessionError

pytestmark = pytest.mark.processes

pytest.importorskip("torch")

SCRIPT = """
from physx_core import DatasetConfig, NetworkConfig, Training

def training(epochs, **more):
    network = NetworkConfig(
        "torch/fc", {"layers": [3, 8, 2], "net_fields": "x", "opt_fields": "y"}, loss="MSELoss",
        optimizer="Adam", lr=1e-2, scheduler="CosineAnnealingLR", scheduler_kwargs={"T_max": 10},
        optimization_kwargs={"accumulate": 3, "gradient_clip": 0.5})
    return Training(network, DatasetConfig(existing_dir="data", normalize=True), epoch_nb=epochs,
                    batch_size=7, batch_nb=20, seed=3, **more)

if __name__ == "__main__":
    training(100_000, session_name="cut").execute()
"""
PARAMETERS = "parameters.safetensors"


@pytest.fixture
def training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((100, 3))
    with Dataset.create("data") as dataset:
        dataset.append("training", {"x": x, "y": np.sin(x[:, :2])})
    Path("script.py").write_text(SCRIPT)
    return runpy.run_path("script.py", run_name="script")["training"]


def parameters(session, number):
    return Path(f"sessions/{session}/network/network_{number}/{PARAMETERS}").read_bytes()


def test_two_halves_equal_the_whole(training):
    training(6, session_name="whole").execute()
    training(3, session_name="halves").execute()
    training(6, session_name="halves", resume=True).execute()
    assert parameters("whole", 0) == parameters("halves", 1)
    assert parameters("halves", 0) != parameters("halves", 1)
    assert [p.name for p in Path("sessions").iterdir() if p.name.startswith("halves")] == ["halves"]


@pytest.mark.parametrize("name", [PARAMETERS, "optimization.safetensors", "checkpoint.toml"])
def test_a_damaged_checkpoint_is_stepped_over(training, name):
    training(5, session_name="whole").execute()
    training(2, session_name="run").execute()
    training(4, session_name="run", resume=True).execute()
    file = Path("sessions/run/network/network_1") / name
    damaged = bytearray(file.read_bytes())
    damaged[len(damaged) // 2] ^= 4
    file.write_bytes(damaged)
    with pytest.warns(UserWarning, match=f"network_0, because later.*\n.*network_1: {name}"):
        training(5, session_name="run", resume=True).execute()
    assert parameters("run", 2) == parameters("whole", 0)
    assert file.read_bytes() == damaged
    training(5, session_name="run", resume=True).execute()  # from network_2, without a warning


@pytest.mark.slow
def test_ctrl_c_within_an_epoch_and_resume(training):
    process = subprocess.Popen([sys.executable, "script.py"], stderr=subprocess.PIPE, text=True)
    stats, deadline = Path("sessions/cut/stats/scalars.csv"), time.monotonic() + 60
    while not (stats.exists() and stats.stat().st_size > 5000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, text = process.communicate(timeout=30)
    assert "KeyboardInterrupt" in text
    lines = [line.split(",") for line in stats.read_text().splitlines()]
    reached = max(int(line[1]) for line in lines if line[0] == "batch") // 20 + 2
    words = [
        "train",
        "--config",
        "sessions/cut/config.toml",
        "--resume",
        "--epoch-nb",
        f"{reached}",
    ]
    assert main(words) == 0
    training(reached, session_name="whole").execute()
    assert parameters("whole", 0) == parameters("cut", 1)


@pytest.mark.reported(
    "pytorch-lightning#1463",
    "pytorch-lightning#18727",
    "transformers#28544",
    "fairseq#3531",
    about="the patience of early stopping begins anew after resuming",
)
def test_halves_equal_the_whole_with_early_stopping_and_the_best(training):
    with Dataset.open("data", writable=True, session="data") as dataset:
        x = np.random.default_rng(1).standard_normal((30, 3))
        dataset.append("validation", {"x": x, "y": np.sin(x[:, :2]) + 0.3})
    options = {"patience": 3, "min_improvement": 2e-4, "validation_every": 2}
    whole = training(400, session_name="whole", **options)
    whole.execute()
    assert whole.stopped and 8 < whole.epoch_id < 400 and whole.best.epoch < whole.epoch_id
    for epochs in (3, whole.epoch_id - 3, whole.epoch_id - 1, 400, 400):
        half = training(epochs, session_name="halves", resume=epochs != 3, **options)
        half.execute()
    assert (half.stopped, half.epoch_id) == (whole.stopped, whole.epoch_id)
    assert parameters("whole", 0) == parameters("halves", 3)  # the last resume wrote nothing more
    assert parameters("whole", "best") == parameters("halves", "best")
    assert recorded("whole") == recorded("halves")


def recorded(session):
    """Return the lines of the file of numbers."""
    return Path(f"sessions/{session}/stats/scalars.csv").read_text().splitlines()


def test_a_training_whose_samples_environments_made_in_the_first_epoch(training):
    network = NetworkConfig(
        "torch/fc",
        {"layers": [2, 8, 2], "net_fields": "state", "opt_fields": "next_state"},
        loss="MSELoss",
        optimizer="Adam",
    )
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=2)
    options = {"batch_nb": 6, "batch_size": 5, "seed": 1}
    data = DatasetConfig(normalize=True)
    Training(network, data, spring, session_name="whole", epoch_nb=5, **options).execute()
    more = {"session_name": "halves", **options}
    Training(network, data, spring, epoch_nb=2, **more).execute()
    Training(network, data, spring, epoch_nb=3, resume=True, **more).execute()
    assert (
        main(["train", "--config", "sessions/halves/config.toml", "--resume", "--epoch-nb=5"]) == 0
    )
    assert parameters("whole", 0) == parameters("halves", 2)
    with Dataset.open("sessions/halves") as dataset:
        assert dataset.num_samples("training") == 30


def test_what_cannot_be_resumed(training):
    with pytest.raises(SessionError, match="no session"):
        training(1, session_name="none", resume=True).execute()
    Path("sessions/empty").mkdir(parents=True)
    with pytest.raises(CheckpointError, match="no network in"):
        training(1, session_name="empty", resume=True).execute()
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, always_produce=True)
    options = {"epoch_nb": 1, "batch_nb": 1, "batch_size": 5, "session_name": "online"}
    Training(NetworkConfig("toy/linear"), None, spring, **options).execute()
    for changed, others, name in (
        ({"num_clients": 2}, {}, "num_clients was 1 and is now 2"),
        ({"env_kwargs": {"mass": 2.0}}, {}, "env_kwargs was {}"),
        ({"seed": 3}, {}, "seed was"),
        ({}, {"batch_size": 6}, "batch_size was 5 and is now 6"),
    ):
        other = dataclasses.replace(spring, **changed)
        with pytest.raises(ConfigError, match=f"cannot be resumed .*{name}"):
            Training(
                NetworkConfig("toy/linear"), None, other, resume=True, **{**options, **others}
            ).execute()
    other = NetworkConfig("toy/linear", network_kwargs={"net_fields": "x", "opt_fields": "y"})
    training(1, session_name="run").execute()
    data = DatasetConfig(existing_dir="data")
    with pytest.raises(ConfigError, match="network.network was 'torch/fc' and is now 'toy/linear'"):
        Training(other, data, session_name="run", resume=True, epoch_nb=2, batch_size=5).execute()
