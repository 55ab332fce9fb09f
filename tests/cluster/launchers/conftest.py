"""Two nodes of Ray, one of Slurm, and runs of the command line on them."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from one_node_slurm import Slurm, wait_for

from physx_core import Dataset

PROGRAMS = Path(__file__).parents[1] / "programs"
WALK = f"{PROGRAMS / 'cluster_envs.py'}:Walk"


class Runs:
    """Runs of the command line in the test's folder, and what their clients leave."""

    def __init__(self, folder):
        self.folder, self.notes = folder, folder / "notes"
        self.notes.mkdir()
        self.count = 0
        self.log = folder / "log"

    def start(self, *words, clients=2, batches=4, pace=0.0, fail_at=-1, **environment):
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
                [sys.executable, "-m", "physx_core", "generate", WALK, *map(str, options), *words],
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


@pytest.fixture
def runs(tmp_path):
    runs = Runs(tmp_path)
    yield runs
    for _, pid, child, _ in runs.clients():
        for each in (pid, child):
            if is_running(int(each)):  # then the test has failed
                os.kill(int(each), signal.SIGKILL)


class RayCluster:
    """Ray with two nodes on this machine.

    Attributes:
        variables: The environment variables by which a run finds it.
    """

    def __init__(self):
        from ray.cluster_utils import Cluster

        soon = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500}
        settings = {**soon, "health_check_failure_threshold": 4}
        self._cluster = Cluster(
            initialize_head=True,
            head_node_args={
                "num_cpus": 1,
                "include_dashboard": False,
                "_system_config": settings,
            },
        )
        self.nodes = [self._cluster.head_node, self.add_node()]
        self.variables = {"RAY_ADDRESS": self._cluster.address}

    def add_node(self):
        return self._cluster.add_node(num_cpus=1)

    def raylet_of(self, node):
        return node.all_processes["raylet"][0].process.pid

    def kill(self, node):
        """Kill all processes of a node, as if its machine lost its power."""
        raylet = self.raylet_of(node)
        for pid in [raylet, *descendants(raylet)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def close(self):
        import ray

        ray.shutdown()
        self._cluster.shutdown()


def descendants(pid):
    found, children = [], {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(stat.parent.name))
    found += children.get(pid, [])
    for each in found:  # grows while it is read
        found += children.get(each, [])
    return found


@pytest.fixture(scope="session")
def ray_cluster():
    """Ray with two nodes of one processor each."""
    pytest.importorskip("ray")
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # the names of sockets must be short
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
        cluster = RayCluster()
        yield cluster
        cluster.close()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def slurm():
    """Slurm with one node of four processors: this machine."""
    folder = Path(tempfile.mkdtemp(prefix="slurm", dir="/tmp"))
    cluster = Slurm(folder)
    reason = cluster.start()
    try:
        if reason and os.environ.get("CI") != "true":
            pytest.skip(reason)
        assert not reason, reason
        yield cluster
    finally:
        cluster.stop()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def eventually():
    """Return a function that waits for a condition, and fails if it is not met."""

    def wait(condition, seconds=30):
        began = time.monotonic()
        assert wait_for(condition, seconds), f"not within {time.monotonic() - began:.0f} s"

    return wait
