"""Runs of the command line on clusters."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from one_node_slurm import wait_for

from physx_core import Dataset

PROGRAMS = Path(__file__).parents[1] / "programs"
WALK = f"{PROGRAMS / 'cluster_envs.py'}:Walk"
TRIPS = f"{PROGRAMS / 'cluster_envs.py'}:Trips"


class Runs:
    """Runs of the command line in the test's folder, and what their clients leave."""

    def __init__(self, folder):
        self.folder, self.notes = folder, folder / "notes"
        self.notes.mkdir()
        self.count = 0
        self.log = folder / "log"

    def start(
        self, *words, clients=2, batches=4, pace=0.0, fail_at=-1, program=WALK, **environment
    ):
        """Start a run; what it prints goes into `log`."""
        self.count += 1
        self.session = self.folder / "sessions" / f"run{self.count}"
        kwargs = [f"notes='{self.notes}'", f"pace={pace}", f"fail_at={fail_at}"]
        options = [
            *("--batch-nb", batches, "--batch-size", 10, "--session-name", self.session.name),
            *("--environment.num-clients", clients, "--environment.seed", 3),
            *("--environment.env-kwargs", *kwargs),
        ]
        with self.log.open("wb") as log:
            return subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "physx_core",
                    "generate",
                    program,
                    *map(str, options),
                    *words,
                ],
                cwd=self.folder,
                env={**os.environ, **environment},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def finish(self, process, seconds=120):
        """Wait for the end of a run; return its exit status, and what it said."""
        try:
            return process.wait(seconds), self.log.read_text()
        finally:
            process.kill()
            process.wait()

    def rows(self, *words, **options):
        """Return the rows of a run that succeeds, by field."""
        status, said = self.finish(self.start(*words, **options))
        assert status == 0, said
        return self.stored()

    def stored(self):
        with Dataset.open(self.session) as dataset:
            data = dataset["training"]
            return {name: data[name][:] for name in dataset.fields("training")}

    @staticmethod
    def same(rows, others):
        """Return whether two runs have the same rows, bit for bit."""
        return rows.keys() == others.keys() and all(
            np.array_equal(rows[name], others[name]) for name in rows
        )

    def clients(self):
        """Return (instance, pid, pid of its child, node) of all clients that ever began."""
        return [tuple(map(str, path.name.split("-")[:4])) for path in self.notes.iterdir()]

    def wait_for_clients(self, count, process):
        def begun():
            assert process.poll() is None, self.log.read_text()
            return len(self.clients()) >= count

        assert wait_for(begun, 90), self.log.read_text()

    def nothing_is_left(self):
        """Return whether no client, and no process of one, is left, and no hidden folder."""
        running = [pid for _, *pids, _ in self.clients() for pid in pids if is_running(int(pid))]
        return not running and not list(self.folder.glob(".physx-*"))


def is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.fixture(scope="session")
def local_rows(tmp_path_factory):
    """A function that returns the first rows of a run on this machine alone.

    A longer run begins with the rows of a shorter one, so one is made for each program and number
    of clients.
    """
    made = {}

    def first(clients=2, batches=4, program=WALK):
        kind = program, clients
        if kind not in made:
            options = {"program": program, "clients": clients, "batches": 30}
            made[kind] = Runs(tmp_path_factory.mktemp("local")).rows(**options)
        return {name: values[: 10 * batches] for name, values in made[kind].items()}

    return first


@pytest.fixture
def trips():
    """Return the program of independent episodes."""
    return TRIPS


@pytest.fixture
def runs(tmp_path):
    runs = Runs(tmp_path)
    yield runs
    for _, pid, child, _ in runs.clients():
        for each in (pid, child):
            if is_running(int(each)):  # then the test has failed
                os.kill(int(each), signal.SIGKILL)


@pytest.fixture
def eventually():
    """Return a function that waits for a condition, and fails if it is not met."""

    def wait(condition, seconds=30):
        began = time.monotonic()
        assert wait_for(condition, seconds), f"not within {time.monotonic() - began:.0f} s"

    return wait
