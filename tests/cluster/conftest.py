"""Two nodes of Ray, and one of Slurm: started once for all tests of a process."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
from pathlib import Path

import pytest
from one_node_slurm import Slurm


class RayCluster:
    """Ray with two nodes on this machine.

    Attributes:
        variables: The environment variables by which a run finds it.
    """

    def __init__(self, **settings):
        from ray.cluster_utils import Cluster

        soon = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500}
        settings = {**soon, "health_check_failure_threshold": 4, **settings}
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

    def kill_head(self):
        """Kill the process that holds the cluster together."""
        for each in self._cluster.head_node.all_processes["gcs_server"]:
            os.kill(each.process.pid, signal.SIGKILL)

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
    for stat in (folder / "stat" for folder in Path("/proc").glob("[0-9]*")):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(stat.parent.name))
    found += children.get(pid, [])
    for each in found:  # grows while it is read
        found += children.get(each, [])
    return found


@contextlib.contextmanager
def started_ray(**settings):
    """Start Ray with two nodes of one processor each."""
    pytest.importorskip("ray")
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # the names of sockets must be short
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
        cluster = RayCluster(**settings)
        yield cluster
        cluster.close()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def ray_cluster():
    """Ray with two nodes of one processor each."""
    with started_ray() as cluster:
        yield cluster


@pytest.fixture
def mortal_ray():
    """Another cluster, whose processes end 4 s after its head, not 60 s."""
    with started_ray(gcs_rpc_server_reconnect_timeout_s=4) as cluster:
        yield cluster


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
