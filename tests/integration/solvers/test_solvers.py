"""Campaigns of real solvers that are interrupted and resumed equal those that nobody disturbed."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import sizes

from physx_core import Dataset, DatasetConfig, NetworkConfig, Training
from physx_core.dataset import EpisodeStatus
from physx_core.errors import PhysxError

pytestmark = [
    pytest.mark.processes,
    pytest.mark.slow,
    pytest.mark.usefixtures("nothing_stays_behind"),
]

CLIENTS = 2
ENDED = (EpisodeStatus.FINISHED, EpisodeStatus.FAILED)


@dataclasses.dataclass(frozen=True)
class Solver:
    """A campaign of a solver.

    Attributes:
        environment: Name of the class in a file of the same name, or a reference.
        needs: Module or program.
        package: What installs it.
        episodes: Number of simulations.
        options: Further options of the command.
        fails: Whether it fails for some parameters.
        silent: Numbers of those that lose their client, so that they are simulated twice.
        python: The interpreter that has it.
    """

    environment: str
    needs: str
    package: str
    episodes: int
    options: tuple[str, ...] = ()
    fails: bool = False
    silent: tuple[int, ...] = ()
    python: str = sys.executable

    @property
    def reference(self):
        """Its environment on a command line."""
        if "/" in self.environment:
            return self.environment
        place = Path(__file__).parent / f"{self.environment.lower()}.py"
        return f"{place}:{self.environment}"

    def require(self):
        """Skip the test where the solver is not installed, but not in CI."""
        if shutil.which(self.needs) or has_module(self.python, self.needs):
            return
        if os.environ.get("CI"):
            pytest.fail(f"{self.needs} must be there: CI installs {self.package}")
        pytest.skip(f"{self.needs} is not installed: it is in {self.package}")


def has_module(python, name):
    """Return whether an interpreter has a module."""
    found = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({name!r}) is None)"
    return shutil.which(python) is not None and not subprocess.run([python, "-c", found]).returncode


DEBIAN = "/usr/bin/python3"
"""The interpreter of the system, whose packages are not for that of the run."""
PROGRAM = [DEBIAN, str(Path(__file__).with_name("plate_program.py"))]
RANGES = (
    '{k = {low = 0.1, high = 10.0, distribution = "log_uniform"}, '
    "spot = {low = [0.2, 0.2], high = [0.8, 0.8], shape = [2]}}"
)
PATIENT = ("--environment.timeout", "300")
"""Numba compiles for half a minute when it is first used."""
SOLVERS = {
    "scikit-fem": Solver("Heat", "skfem", "scikit-fem", 40, fails=True),
    "CalculiX": Solver("Beam", "ccx", "Debian's calculix-ccx", 30),
    "PyElastica": Solver("Rod", "elastica", "pyelastica", 20, PATIENT),
    "dolfinx": Solver(
        "Plate",
        "dolfinx",
        "Debian's python3-dolfinx",
        30,
        (*PATIENT, "--environment.launcher-kwargs.python", DEBIAN),
        python=DEBIAN,
    ),
    "dolfinx as a program": Solver(
        "external/program",
        "dolfinx",
        "Debian's python3-dolfinx",
        30,
        (
            *(*PATIENT, "--environment.episode-steps", "1"),
            *("--environment.env-kwargs.program", json.dumps(PROGRAM)),
            *("--environment.env-kwargs.ranges", RANGES),
        ),
        python=DEBIAN,
    ),
}
FAULTS = '{3 = "hangs", 7 = "crashes", 11 = "is silent"}'


@pytest.fixture(params=SOLVERS)
def solver(request):
    """Each of the solvers that is installed."""
    SOLVERS[request.param].require()
    return SOLVERS[request.param]


class Run:
    """A campaign in a folder of its own."""

    def __init__(self, solver, folder, sessions="sessions"):
        """Store what is run where."""
        self.solver, self.folder = solver, folder
        self.sessions = folder / sessions
        folder.mkdir(exist_ok=True)

    def start(self, clients=CLIENTS):
        """Begin in the background."""
        alone = ["--environment.no-as-tcp-ip-client"]
        if self.solver.python != sys.executable:
            clients = clients or 1  # this interpreter does not have it
        several = ["--environment.num-clients", str(clients)]
        return self._command(
            self.solver.reference,
            *("--episodes", str(self.solver.episodes), "--session-dir", str(self.sessions)),
            *("--environment.sampler", "physx/sobol", "--environment.seed", "1"),
            *("--session-name", "run", "--max-failed", "10"),
            "--no-prove-independence",  # each number is to be simulated once
            *(several if clients else alone),
            *self.solver.options,
        )

    def resume(self):
        """Simulate what is missing."""
        succeed(self._command(str(self.sessions / "run"), "--resume"))

    def _command(self, *words):
        command = [sys.executable, "-m", "physx_core", "generate", *words]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        return subprocess.Popen(command, cwd=self.folder, **streams)

    def dataset(self):
        """Open the dataset."""
        return Dataset.open(self.sessions / "run")

    def ended(self):
        """Return the numbers that have a record, at any time of a run."""
        try:
            with self.dataset() as dataset:
                known = dataset.recorded_episodes("training")
        except PhysxError:  # it has not begun
            return set()
        if known is None:
            return set()
        return {n for n, s in zip(known.episode.tolist(), known.status, strict=True) if s in ENDED}

    def solved(self, what="begins"):
        """Return how often the solver began, or ended, each number."""
        log = self.folder / "solver.log"
        lines = log.read_text().splitlines() if log.exists() else ()
        return Counter(int(line.split()[0]) for line in lines if line.endswith(what))

    def contents(self):
        """Return rows, parameters, failures and statistics, as bytes."""
        with self.dataset() as dataset:
            assert dataset.verify() == []
            rows = {name: values[:].tobytes() for name, values in dataset["training"].items()}
            table = {name: values[:] for name, values in dataset["episodes"].items()}
            names = [field for field in table if field not in TABLE]
            parameters = {
                int(number): [table[name][place].tobytes() for name in names]
                for place, number in enumerate(table["episode"])
            }
            failed = [each.episode for each in dataset.failed_episodes("training")]
            scale = {
                name: (found.mean.tobytes(), found.std.tobytes())
                for name, found in dataset.normalization.items()
            }
        return rows, parameters, failed, scale


TABLE = {
    *("mode_index", "campaign", "episode", "count", "first_row", "rows", "part", "status"),
    "seconds",
}
"""Fields of the table of episodes that are no parameters."""


def succeed(process):
    said, _ = process.communicate(timeout=300)
    assert process.returncode == 0, said


def wait_for(happened, process):
    while not happened():
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.02)


def interrupt(run, share, number=signal.SIGKILL):
    """Start a campaign, and send it a signal when so many of its simulations are stored."""
    process = run.start()
    wait_for(lambda: len(run.ended()) >= share, process)
    process.send_signal(number)
    said, _ = process.communicate(timeout=60)
    wait_until_quiet(run)
    return process.returncode, said


def wait_until_quiet(run):
    """Wait until the clients of a killed run have ended."""
    folder, deadline = os.fsencode(run.folder), time.monotonic() + 60
    while any(at == folder for at in working_folders()):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def working_folders():
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if int(process.name) != os.getpid():
                yield os.fsencode((process / "cwd").readlink())
        except OSError:
            continue


def check_resumed(run, whole):
    """Resume; only what was running is simulated again, and everything equals another run's."""
    stored, begun = run.ended(), run.solved()
    running = set(begun) - stored  # or was on its way to the dataset
    assert stored
    assert len(running) <= 2 * CLIENTS
    run.resume()
    after = run.solved()
    missing = set(range(run.solver.episodes)) - stored
    assert {number for number in after if after[number] > begun[number]} == missing
    twice = Counter({*running, *run.solver.silent})
    assert not after - (Counter(range(run.solver.episodes)) + twice + twice)
    if not running & {*run.solver.silent}:
        assert after == Counter(range(run.solver.episodes)) + twice
    check_equal(run, whole)


def check_equal(run, whole):
    for found, wanted in itertools.zip_longest(run.contents(), whole.contents()):
        assert found == wanted


def undisturbed(solver, folder, clients=0):
    """Return a campaign that nobody interrupts, by default in one process."""
    run = Run(solver, folder)
    succeed(run.start(clients))
    assert run.solved() == Counter([*range(solver.episodes), *solver.silent])
    assert bool(run.contents()[2]) == solver.fails
    return run


@pytest.fixture
def whole(solver, tmp_path):
    """An undisturbed campaign."""
    return undisturbed(solver, tmp_path / "whole")


def test_killed_campaign_is_resumed(solver, whole, tmp_path):
    rng = random.Random(f"{sizes.seed()} {solver.environment}")
    run = Run(solver, tmp_path / "cut")
    status, _ = interrupt(run, rng.randrange(1, solver.episodes - 5))
    assert status == -signal.SIGKILL
    check_resumed(run, whole)
    assert trained(run.sessions, tmp_path / "a") == trained(whole.sessions, tmp_path / "b")


def trained(sessions, folder):
    """Return the parameters of a small network that has learned from a campaign."""
    pytest.importorskip("torch")
    dataset = sessions / "run" / "dataset"
    with Dataset.open(dataset) as known:
        (wanted,) = (name for name in ("temperature", "displacement", "position")
                     if name in known.fields("training"))  # fmt: skip
        inputs = known.fields("training")["given"].shape[0]
        outputs = known.fields("training")[wanted].shape
    network = NetworkConfig(
        "torch/fc",
        {"layers": [inputs, 8, int(np.prod(outputs))], "output_shape": outputs,
         "net_fields": "given", "opt_fields": wanted},
        loss="MSELoss",
        optimizer="Adam",
    )  # fmt: skip
    data = DatasetConfig(existing_dir=str(dataset), normalize=True)
    training = Training(
        network, data, epoch_nb=2, batch_size=8, seed=3, session_dir=str(folder), quiet=True
    )
    training.execute()
    return (folder / "training/network/network_0/parameters.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 128 + signal.SIGTERM)]
)
def test_interrupted_campaign_is_resumed(number, status, tmp_path):
    solver = SOLVERS["scikit-fem"]
    solver.require()
    run = Run(solver, tmp_path / "cut")
    found, said = interrupt(run, 15, number)
    assert found == status
    assert f"physx generate {run.sessions / 'run'} --resume" in said
    check_resumed(run, undisturbed(solver, tmp_path / "whole", clients=3))


def test_campaign_on_a_full_disk_is_resumed(small_disk, tmp_path):
    solver = SOLVERS["scikit-fem"]
    solver.require()
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(shutil.disk_usage(small_disk).free - (700 << 10)))
    run = Run(solver, tmp_path / "cut", small_disk)
    process = run.start()
    said, _ = process.communicate(timeout=60)
    assert process.returncode
    assert "the disk is full" in said
    ballast.unlink()
    wait_until_quiet(run)
    check_resumed(run, undisturbed(solver, tmp_path / "whole"))


@pytest.mark.parametrize("share", [2, 10, 12])
def test_campaign_with_hangs_and_crashes_is_resumed(share, tmp_path):
    """Before any of them, while one is silent, and after that."""
    solver = SOLVERS["CalculiX"]
    solver.require()
    options = ("--environment.env-kwargs.faults", FAULTS, "--environment.episode-timeout", "3")
    solver = dataclasses.replace(solver, options=options, fails=True, silent=(11,))
    run = Run(solver, tmp_path / "cut")
    interrupt(run, share)
    whole = undisturbed(solver, tmp_path / "whole", clients=3)
    assert whole.contents()[2] == [3, 7, 11]
    check_resumed(run, whole)
