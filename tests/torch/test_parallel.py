"""Two processes that torchrun starts train one network as one process does."""

import csv
import os
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from physx_core import Dataset

pytest.importorskip("torch.distributed")

SCRIPT = '''
import os, sys, torch
from physx_core import DatasetConfig, NetworkConfig, Training
from physx_torch import FC, TorchOptimization

class Net(FC):
    """Has parameters that the loss does not depend on."""

    def __init__(self):
        super().__init__([3, 8, 2], net_fields="x", opt_fields="y")
        self.unused = torch.nn.Linear(2, 2)

class Extra(TorchOptimization):
    def transform_loss(self, loss, data):
        return {"loss": loss.item(), "size": float(data["x"].abs().mean())}

def training(batch_size, name, epochs=4, seed=3, **more):
    network = NetworkConfig(
        Net, optimization=Extra, loss="MSELoss", optimizer="Adam", lr=1e-2, data_type="float64",
        device="cpu", scheduler="ReduceLROnPlateau", scheduler_kwargs={"patience": 0},
        optimization_kwargs={"gradient_clip": 0.5, "accumulate": 2})
    return Training(network, DatasetConfig(existing_dir="data", normalize=True), epoch_nb=epochs,
                    batch_size=batch_size, seed=seed, session_name=name, **more)

if __name__ == "__main__":
    torch.set_num_threads(1)
    exec(sys.argv[1])
'''
DIES = """
class Dies(Training):
    def batch_begin(self):
        if self.group.rank == 1 and self.batch_id == 3:
            os._exit(7)
made = training(5, "dies")
made.__class__ = Dies
made.execute()
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder with a dataset whose last batches are short: 41 rows, and 5 to validate with."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    with Dataset.create("data") as dataset:
        for mode, rows in (("training", 41), ("validation", 5)):
            x = rng.standard_normal((rows, 3))
            dataset.append(mode, {"x": x, "y": np.sin(x[:, :2])})
    Path("script.py").write_text(SCRIPT)
    return tmp_path


def start(code):
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.Popen(
        [sys.executable, *launcher, "script.py", code],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(code):
    return ended(start(code))


def ended(process):
    """Return exit status and output; what hangs is ended, with the processes that it started."""
    try:
        text, _ = process.communicate(timeout=120)
    finally:
        if process.poll() is None:
            process.terminate()
    return process.returncode, text


def parameters(session, number=0):
    return load_file(f"sessions/{session}/network/network_{number}/parameters.safetensors")


def numbers(session):
    with Path(f"sessions/{session}/stats/scalars.csv").open() as stream:
        return {tuple(row[:3]): float(row[3]) for row in list(csv.reader(stream))[1:]}


FREE = """
made = training(5, "free", 2, seed=None)
with made:
    made.execute()
    mine = [float(p.detach().abs().sum()) for p in made.learner.network.parameters()]
    assert mine == made.group.tell(mine), mine
"""


def test_two_processes_equal_one_with_the_doubled_batch():
    runpy.run_path("script.py", run_name="script")["training"](10, "one").execute()
    code = "training(5, 'two', 2).execute(); training(5, 'two', 4, resume=True).execute()"
    status, text = run(f"{code}\n{FREE}")  # without a seed they begin alike too
    assert status == 0, text
    assert sorted(p.name for p in Path("sessions").iterdir()) == ["free", "one", "two"]
    networks = sorted(p.name for p in Path("sessions/two/network").iterdir())
    assert networks == ["network_0", "network_1", "network_best"]
    one, two = parameters("one"), parameters("two", 1)
    for name, value in one.items():
        assert torch.allclose(value, two[name], rtol=0, atol=1e-6), name
    apart, together = numbers("one"), numbers("two")
    assert apart.keys() == together.keys()
    assert ("epoch", "4", "size/validation") in apart
    for name, value in apart.items():
        assert abs(value - together[name]) < 1e-6, name


def test_a_process_that_dies_ends_all():
    began = time.monotonic()
    status, text = run(DIES)
    assert status != 0 and "exitcode  : 7" in text
    assert time.monotonic() - began < 60
    assert not list(Path("sessions/dies").glob("network/network_0"))


def test_ctrl_c_keeps_a_checkpoint_that_can_be_resumed():
    process = start("training(5, 'cut', 100_000).execute()")
    stats, deadline = Path("sessions/cut/stats/scalars.csv"), time.monotonic() + 60
    while not (stats.exists() and stats.stat().st_size > 3000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    status, text = ended(process)
    assert status != 0
    assert Path("sessions/cut/network/network_0/checkpoint.toml").exists(), text
    assert "interrupted after" in Path("sessions/cut/info.txt").read_text()
    last = [line for line in stats.read_text().splitlines() if line.startswith("batch,")][-1]
    epochs = int(last.split(",")[1]) // 5 + 2
    resumed = f"training(5, 'cut', {epochs}, resume=True).execute()"
    status, text = run(f"{resumed}; training(5, 'whole', {epochs}).execute()")
    assert status == 0, text
    one, two = parameters("whole"), parameters("cut", 1)
    assert all(torch.equal(value, two[name]) for name, value in one.items())
