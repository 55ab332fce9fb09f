"""What several files share: a folder and a dataset, and sources of the environments beside this."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file
from simulated import Simulation

from physx_core import Dataset, EnvironmentConfig, Field
from physx_core.sources import ClientSource, LocalSource

SEED = [5, 0, 7]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    """Sessions are relative to the working directory: each test has its own."""
    monkeypatch.chdir(tmp_path)


# Datasets ---------------------------------------------------------------------------------------


@pytest.fixture
def dataset(folder):
    with Dataset.create(folder, max_file_size=0.001) as dataset:
        yield dataset


class Thousand:
    """A thousand rows of two fields, and datasets of them in partitions of 340 rows.

    Attributes:
        rows: Field name to rows.
        fields: The fields.
        size: Size of a partition in GB.
    """

    def __init__(self, folder):
        self.rows = {
            "x": np.random.default_rng(0).normal(size=(1000, 5)),
            "n": np.arange(1000, dtype="int32"),
        }
        self.fields = [Field("x", (5,), unit="m"), Field("n", (), "int32", role="additional")]
        self.size = 3e-5
        self._whole = folder / "data"
        self._make(self._whole, self.rows)

    def write(self, folder, rows=None, session="run", **options):
        """Make a dataset; one of all rows is copied, which is quicker."""
        if rows is None and session == "run" and not options:
            shutil.copytree(self._whole, folder)
        else:
            self._make(folder, self.rows if rows is None else rows, session, **options)

    def check(self, folder, rows, *, counted=True):
        """Check rows, statistics and files; the statistics are stored if `counted`."""
        with Dataset.open(folder) as dataset:
            assert dataset.num_samples("training") == len(rows["n"])
            for name, values in rows.items():
                np.testing.assert_array_equal(dataset["training"][name][:], values)
            found = dataset.normalization["x"]
            np.testing.assert_allclose(found.mean, rows["x"].mean(axis=0), atol=1e-12)
            np.testing.assert_allclose(found.std, rows["x"].std(axis=0), rtol=1e-9)
            assert dataset.verify() == []
        plain = json.loads((folder / "dataset.json").read_text())
        partitions = plain["modes"]["training"]["partitions"]
        if counted:
            assert all(partition["counted"] for partition in partitions)
            stored = load_file(folder / plain["statistics"]["file"])
            assert stored["training/x/count"] == len(rows["n"])
        for session in {partition["session"] for partition in partitions}:
            assert (folder / f"{session}.h5").exists()

    def part(self, start, stop):
        return {name: values[start:stop] for name, values in self.rows.items()}

    def stacked(self, *blocks):
        """Return blocks as one; each is given as such, or as where it begins and ends."""
        blocks = [self.part(*block) if isinstance(block, tuple) else block for block in blocks]
        return {name: np.concatenate([block[name] for block in blocks]) for name in self.rows}

    def _make(self, folder, rows, session="run", **options):
        with Dataset.create(folder, session, max_file_size=self.size, **options) as dataset:
            dataset.define_fields("training", self.fields)
            dataset.append("training", rows)


@pytest.fixture(scope="session")
def thousand(tmp_path_factory):
    """Rows, and datasets of them."""
    return Thousand(tmp_path_factory.mktemp("thousand"))


# Sources ----------------------------------------------------------------------------------------


class Services:
    """Keeps what environments ask for; the prediction doubles x."""

    def __init__(self):
        self.kept, self.shown, self.asked = {}, [], []

    def predict(self, fields):
        self.asked.append(1)
        return {"y": 2 * np.asarray(fields["x"])}

    def save_parameters(self, instance_id, values):
        self.kept[instance_id] = values

    def load_parameters(self, instance_id):
        return self.kept.get(instance_id, {})

    def show(self, instance_id, step, events):
        self.shown.append((instance_id, step, events))


def configured(environment, options):
    if isinstance(environment, str) and environment.isidentifier():
        environment = f"{(Path(__file__).parent / 'programs' / 'worker_envs.py')}:{environment}"
    return EnvironmentConfig(environment, **options)


@pytest.fixture
def services():
    """What the sources of this test ask."""
    return Services()


@pytest.fixture
def local(services):
    """Return the source of an environment in this process; a plain name is in worker_envs.py."""

    def make(environment, **options):
        return LocalSource(configured(environment, options), services, SEED)

    return make


@pytest.fixture
def clients(services, nothing_stays_behind):
    """Return the source of an environment in client processes, named as for `local`."""

    def make(environment="Plain", *, run_ahead=None, total=None, **options):
        settings = configured(environment, options)
        return ClientSource(settings, services, SEED, run_ahead=run_ahead, total=total)

    return make


@pytest.fixture
def said(caplog):
    """Return a function: what physx said that matches a pattern."""

    def find(pattern=""):
        texts = [record.getMessage() for record in caplog.records if record.name == "physx"]
        return [text for text in texts if re.search(pattern, text)]

    return find


@pytest.fixture
def simulation():
    """A network and a clock within this thread."""
    with Simulation() as simulation:
        yield simulation


@pytest.fixture
def simulated(services, simulation):
    """Return the source of an environment in clients within this thread, named as for `local`."""

    def make(environment="Plain", *, run_ahead=None, total=None, **options):
        settings = configured(environment, {"launcher": "simulated:SimulatedLauncher", **options})
        options = {"run_ahead": run_ahead, "total": total, "transport": simulation}
        return ClientSource(settings, services, SEED, **options)

    return make


@pytest.fixture
def unhurried():
    """Return a function that makes a client's time for silence longer, the busier the machine is.

    What is added is several times as long as an interpreter takes to start here and now.
    """
    began = time.monotonic()
    command = [sys.executable, "-c", "import physx_core.workers.client.worker, h5py"]
    subprocess.run(command, check=True)
    starting = time.monotonic() - began
    return lambda seconds: round(seconds + 5 * starting, 1)


@pytest.fixture
def process_ids():
    """Return a function: instance number to process id of the clients that a process started."""

    def find(parent=None):
        found = {}
        for command in (folder / "cmdline" for folder in Path("/proc").glob("[0-9]*")):
            try:
                words = command.read_bytes().split(b"\0")
                started_by = int(
                    (command.parent / "stat").read_text().rpartition(")")[2].split()[1]
                )
            except OSError:
                continue
            if b"--instance" in words and started_by == (parent or os.getpid()):
                found[int(words[words.index(b"--instance") + 1])] = int(command.parent.name)
        return found

    return find


# Kills ------------------------------------------------------------------------------------------


@pytest.fixture
def run_killed(nothing_stays_behind):
    """Return a function that runs a program to its end, but kills it after each of some times in s.

    It takes the program, the folder, the times, and arguments; it returns how many were killed, and
    how long the last one ran, in s.
    """
    runners = {}

    def run(program, folder, moments, *words):
        if program not in runners:
            command = [sys.executable, str(Path(__file__).parent / "programs" / "forks.py")]
            runners[program] = subprocess.Popen(
                [*command, program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            assert runners[program].stdout.readline() == "ready\n"
        for kills, moment in enumerate([*moments, None]):
            words_of_run = json.dumps([str(folder), moment, *words])
            began = time.monotonic()
            print(words_of_run, file=runners[program].stdin, flush=True)
            status = int(runners[program].stdout.readline())
            if status != -signal.SIGKILL:
                assert not status
                return kills, time.monotonic() - began
        return None

    yield run
    for runner in runners.values():
        runner.communicate()
