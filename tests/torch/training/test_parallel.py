"""Two processes that torchrun starts train one network as one process does."""

import csv
import runpy
import shutil
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
from physx_core.checkpoint import read
from physx_core.pipelines import read_drawn_rows

pytestmark = [pytest.mark.slow, pytest.mark.processes]

pytest.importorskip("torch.distributed")

SCRIPT = '''
import os, signal, sys, numpy as np, torch
from physx_core import (
    DatasetConfig, Environment, EnvironmentConfig, Field, NetworkConfig, Parameter, Training)
from physx_core.errors import ConfigError
from physx_torch import FC, TorchOptimization

class Net(FC):
    """Has parameters that the loss does not depend on."""

    def __init__(self):
        super().__init__([3, 8, 2], net_fields="x", opt_fields="y")
        self.unused = torch.nn.Linear(2, 2)

class Extra(TorchOptimization):
    def transform_loss(self, loss, batch):
        return {"loss": loss.item(), "size": float(batch.data["x"].abs().mean())}

class Halves(Environment):
    """Makes of each stored sample one with half the target."""

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field("x", (3,)), Field("y", (2,))])

    def step(self):
        self.set_training_data(x=self.sample["x"], y=self.sample["y"] / 2)

class Makes(Environment):
    """Makes samples, and fails or asks for predictions if it is told to."""

    def __init__(self, *, fails_at=None, asks=False, **kwargs):
        super().__init__(**kwargs)
        self.count, self.fails_at, self.asks = 0, fails_at, asks

    def create(self):
        pass

    def init_database(self):
        self.define_training_fields([Field("x", (3,)), Field("y", (2,))])
        self.define_additional_fields([Field("count", (), "int64")])

    def step(self):
        if self.count == self.fails_at:
            raise RuntimeError("enough")
        x = self.rng.normal(size=3)
        if self.asks and self.count:
            x[0] += self.get_prediction(x=x)["y"][0]
        self.set_training_data(x=x, y=np.sin(x[:2]))
        self.set_additional_data(count=self.count)
        self.count += 1

class Peak(Environment):
    """A function of two parameters; each row is an episode."""

    def create(self):
        self.define_parameters([Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)])

    def init_database(self):
        self.define_training_fields([Field("x", (3,)), Field("y", (2,))])

    def reset_parameters(self, a, b):
        self.at = np.array([a, b, 1.0])

    def step(self):
        if self.step_index:
            self.new_episode()
        far = np.sum((self.at[:2] - 0.8) ** 2)
        self.set_training_data(x=self.at, y=10 * np.exp(-8 * far * np.ones(2)))

def active(batch_size, name, over_tcp=True, kind=Training, **more):
    peaks = EnvironmentConfig(Peak, num_clients=2, seed=1, as_tcp_ip_client=over_tcp,
                              sampler="physx/active", sampler_kwargs={"uniform": 0.2})
    return kind(network(), None, peaks, epoch_nb=1, batch_nb=20, batch_size=batch_size, seed=3,
                session_name=name, online="physx/reservoir", online_kwargs=RESERVOIR, **more)

class Stops(Training):
    """Ctrl-C comes to one of the processes."""

    def batch_begin(self):
        if self.group.rank == 1 and self.batch_id == 11:
            os.kill(os.getpid(), signal.SIGINT)

def learning():
    active(5, "active_two").execute()
    try:
        active(5, "stopped_two", over_tcp=False, kind=Stops).execute()
    except KeyboardInterrupt:
        active(5, "stopped_two", over_tcp=False, resume=True).execute()

def generating(batch_size, name, epochs=2, over_tcp=True, *, always=False, online=None,
               kind=Training, resume=False, **made):
    makes = EnvironmentConfig(Makes, num_clients=2, seed=1, as_tcp_ip_client=over_tcp,
                              always_produce=always, env_kwargs=made)
    buffer = {"online": "physx/reservoir", "online_kwargs": online} if online else {}
    return kind(network(), DatasetConfig(normalize=True), makes, epoch_nb=epochs, batch_nb=8,
                batch_size=batch_size, seed=3, session_name=name, resume=resume, **buffer)

class Fails(Training):
    def batch_end(self):
        if (self.epoch_id, self.batch_id) == (1, 3):
            raise RuntimeError("all fail")

RESERVOIR = {"capacity": 30, "watermark": 12, "views": 2}

def living():
    generating(5, "stream_two").execute()
    generating(5, "mixed_two", over_tcp=False, online=RESERVOIR, always=True).execute()
    generating(5, "asking_two", asks=True, online=RESERVOIR).execute()
    failed = {"online": RESERVOIR, "always": True, "over_tcp": False}
    failing = generating(5, "failed_two", kind=Fails, **failed)
    try:
        failing.execute()
    except RuntimeError:
        failing.group.broadcast(None)  # the first one has written the checkpoint
    generating(5, "failed_two", resume=True, **failed).execute()
    generating(5, "fails", over_tcp=False, fails_at=20).execute()

halves = EnvironmentConfig(Halves, as_tcp_ip_client=False, load_samples=True)

def network():
    return NetworkConfig(
        Net, optimization=Extra, loss="MSELoss", optimizer="Adam", lr=1e-2, data_type="float64",
        device="cpu", scheduler="ReduceLROnPlateau", scheduler_kwargs={"patience": 0},
        optimization_kwargs={"gradient_clip": 0.5, "accumulate": 2})

def training(batch_size, name, epochs=4, seed=3, environment=None, kind=Training, **more):
    return kind(network(), DatasetConfig(existing_dir="data", normalize=True), environment,
                epoch_nb=epochs, batch_size=batch_size, seed=seed, session_name=name, **more)

class Cut(Training):
    """Ctrl-C comes to one of the processes, within an epoch."""

    def batch_begin(self):
        if self.group.rank == 1 and (self.epoch_id, self.batch_id) == (1, 2):
            os.kill(os.getpid(), signal.SIGINT)

class Dies(Training):
    def batch_begin(self):
        if self.group.rank == 1 and self.batch_id == 3:
            os._exit(7)

def together():
    training(5, "two", 2).execute()
    training(5, "two", 4, resume=True).execute()
    try:
        training(5, "cut", kind=Cut).execute()
    except KeyboardInterrupt:
        training(5, "cut", resume=True).execute()
    try:
        training(5, "sent", environment=halves).execute()
        raise SystemExit("environments took part")
    except ConfigError as error:
        assert "cannot replay samples for several processes" in str(error)
    training(5, "sent", 3, environment=halves, resume=True).execute()
    with training(5, "free", 2, seed=None) as made:
        made.execute()
        mine = [float(p.detach().abs().sum()) for p in made.learner.network.parameters()]
        assert mine == made.group.broadcast(mine), "without a seed they do not begin alike"
        wide = np.arange(5e5) / 3 if made.group.is_main else None
        told = made.group.broadcast({"x": [wide, (1, "two")]})
        assert told["x"][0].tobytes() == (np.arange(5e5) / 3).tobytes(), "bits were lost"
        assert told["x"][1] == (1, "two") and told["x"][0].shape == (500_000,)
    training(5, "dies", kind=Dies).execute()

if __name__ == "__main__":
    torch.set_num_threads(1)
    exec(sys.argv[1])
'''


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


def alone():
    """What the script defines, for one process."""
    return runpy.run_path("script.py", run_name="script")


def start(code):
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    return subprocess.Popen(
        [sys.executable, *launcher, "script.py", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


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


def agree(session, other, number=0, second=1):
    """Whether one process and two came to the same network."""
    one, two = parameters(session, number), parameters(other, second)
    return all(torch.allclose(value, two[name], rtol=0, atol=1e-6) for name, value in one.items())


def numbers(session):
    with Path(f"sessions/{session}/stats/scalars.csv").open() as stream:
        rows = [row for row in list(csv.reader(stream))[1:] if not row[2].startswith("online/")]
        return {tuple(row[:3]): float(row[3]) for row in rows}


def test_two_processes_train_as_one_with_the_doubled_batch():
    training = (script := alone())["training"]
    training(10, "one").execute()
    training(10, "sent", 1, environment=script["halves"]).execute()
    shutil.copytree("sessions/sent", "sessions/sent_alone")
    training(10, "sent_alone", 3, environment=script["halves"], resume=True).execute()
    status, text = ended(start("together()"))
    assert status != 0 and "exitcode  : 7" in text, text  # the process that died ended the other
    assert text.count("session: sessions/free\n") == 1  # only the first process speaks
    assert "batches of 10 samples, 5 in each of 2 processes" in text
    for path in Path("sessions/dies").glob("network/network_0"):  # what the other one had learned
        assert read(path).progress.epoch < 5
    names = ["cut", "dies", "free", "one", "sent", "sent_alone", "two"]
    assert sorted(path.name for path in Path("sessions").iterdir()) == names
    networks = sorted(path.name for path in Path("sessions/two/network").iterdir())
    assert networks == ["network_0", "network_1", "network_best"]
    assert agree("one", "two")
    assert agree("sent_alone", "sent", 1) and not agree("one", "sent")
    apart, both = numbers("one"), numbers("two")
    assert apart.keys() == both.keys() and ("epoch", "4", "size/validation") in apart
    assert all(abs(value - both[name]) < 1e-6 for name, value in apart.items())
    cut = read(Path("sessions/cut/network/network_0")).progress
    assert (cut.epoch, cut.batch) == (1, 3)  # both ended after the same batch
    resumed = parameters("cut", 1)
    assert all(torch.equal(value, resumed[name]) for name, value in parameters("two", 1).items())


@pytest.mark.faults
def test_two_processes_learn_from_environments_of_the_first_as_one_does():
    script = alone()
    generating, reservoir = script["generating"], script["RESERVOIR"]
    generating(10, "stream", over_tcp=False).execute()
    generating(10, "mixed", over_tcp=False, online=reservoir, always=True).execute()
    generating(10, "asking", over_tcp=False, asks=True, online=reservoir).execute()
    status, text = ended(start("living()"))
    assert status != 0 and "enough" in text, text
    for name in ("stream", "mixed"):
        with Dataset.open(f"sessions/{name}") as one, Dataset.open(f"sessions/{name}_two") as two:
            for field in ("x", "y", "count"):
                assert np.array_equal(one["training"][field][:], two["training"][field][:])
    for name in ("stream", "mixed", "asking"):
        assert agree(name, f"{name}_two", second=0), name
        apart, both = numbers(name), numbers(f"{name}_two")
        assert apart.keys() == both.keys() and ("epoch", "2", "size/training") in apart
        assert all(abs(value - both[key]) < 1e-6 for key, value in apart.items())
    assert agree("mixed", "failed_two")
    drawn = [read_drawn_rows(f"sessions/{name}") for name in ("mixed", "mixed_two", "failed_two")]
    assert np.array_equal(drawn[0], drawn[1]) and np.array_equal(drawn[0], drawn[2])
    assert drawn[0].shape == (16, 10)
    failed = read(Path("sessions/fails/network/network_0")).progress
    assert (failed.epoch, failed.batch) == (0, 4)


@pytest.mark.faults
def test_a_sampler_learns_from_the_losses_of_two_processes_as_from_those_of_one():
    alone()["active"](10, "active", over_tcp=False).execute()
    status, text = ended(start("learning()"))
    assert status == 0, text
    with Dataset.open("sessions/active") as one:
        expected = {name: one["parameters"][name][:] for name in ("set", "a", "b")}
    assert np.mean((expected["a"] > 0.5) & (expected["b"] > 0.5)) > 0.4  # it has learned something
    for name in ("active_two", "stopped_two"):
        with Dataset.open(f"sessions/{name}") as two:
            for parameter, values in expected.items():
                assert np.abs(two["parameters"][parameter][:] - values).max() < 1e-6
        assert agree("active", name, second=int(name == "stopped_two")), name


@pytest.mark.faults
def test_ctrl_c_at_the_launcher_keeps_a_checkpoint_that_can_be_resumed():
    process = start("training(5, 'cut', 100_000).execute()")
    stats, deadline = Path("sessions/cut/stats/scalars.csv"), time.monotonic() + 60
    while not (stats.exists() and stats.stat().st_size > 3000) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    status, text = ended(process)
    assert status != 0
    assert Path("sessions/cut/network/network_0/checkpoint.toml").exists(), text
    assert "interrupted after" in Path("sessions/cut/info.txt").read_text()
    training = alone()["training"]
    epochs = read(Path("sessions/cut/network/network_0")).progress.epoch + 2
    training(10, "cut", epochs, resume=True).execute()
    training(10, "whole", epochs).execute()
    assert agree("whole", "cut")
