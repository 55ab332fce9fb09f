"""A training that began by replaying stored samples goes on bit for bit."""

import shutil
from pathlib import Path

import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Training,
)

pytest.importorskip("torch")

PARAMETERS = "parameters.safetensors"


def parameters(session, number):
    return Path(f"sessions/{session}/network/network_{number}/{PARAMETERS}").read_bytes()


def train(session, epochs, **options):
    network = NetworkConfig(
        "torch/fc",
        {"layers": [3, 8, 2], "net_fields": ["state", "force"], "opt_fields": "next_state"},
        loss="MSELoss",
        optimizer="Adam",
        lr=1e-2,
    )
    heavier = EnvironmentConfig(
        "toy/spring", {"mass": 2.0}, as_tcp_ip_client=False, load_samples=True, seed=1
    )
    data = DatasetConfig(existing_dir="sessions/run", normalize=True)
    Training(
        network, data, heavier, epoch_nb=epochs, batch_size=7, seed=3, session_name=session,
        **options,
    ).execute()  # fmt: skip


@pytest.mark.slow
def test_two_halves_equal_the_whole(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spring = EnvironmentConfig("toy/spring", as_tcp_ip_client=False, seed=0)
    DataGeneration(spring, session_name="run", batch_nb=5, batch_size=20).execute()
    train("whole", 4)
    train("halves", 2)
    shutil.rmtree("sessions/run")  # the copy is all that is needed
    train("halves", 4, resume=True)
    assert parameters("whole", 0) == parameters("halves", 1)
    assert parameters("halves", 0) != parameters("halves", 1)
    with Dataset.open("sessions/whole") as whole, Dataset.open("sessions/halves") as halves:
        for name, view in whole["training"].items():
            assert view[:].tobytes() == halves["training"][name][:].tobytes()
