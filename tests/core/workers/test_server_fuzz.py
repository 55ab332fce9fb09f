"""The server under random and mutated frames, from strangers and from clients, during a run.

`rogue_client.py` sends them from a process of its own. Meanwhile real clients make rows, and
the memory of this process is watched.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core import DataGeneration, Dataset, EnvironmentConfig
from physx_core.net import Kind, pack
from physx_core.workers.parameter_sets import ParameterSets
from physx_core.workers.server.client_group import ClientGroup

pytestmark = pytest.mark.processes

ROGUE = Path(__file__).parents[1] / "programs" / "rogue_client.py"
ENVS = Path(__file__).parents[1] / "programs" / "worker_envs.py"
TOKEN = "a token for this test"
MEGABYTE = 1 << 20
LONG = pytest.mark.faults
COUNTS = [3000, pytest.param(20_000, marks=LONG)]


@pytest.fixture
def rogue(monkeypatch, nothing_stays_behind):
    """Start rogues; they are gone at the end."""
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)
    started = []

    def start(port, instance, frames, seed):
        arguments = [f"127.0.0.1:{port}", instance, seed, frames]
        command = [sys.executable, str(ROGUE), *map(str, arguments)]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def report_of(process):
    """What a rogue that has ended did."""
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return json.loads(output)


def memory():
    """Memory that this process has now, in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


# Before authentication --------------------------------------------------------------------------


class WhileAttacked(DataGeneration):
    """Makes batches as long as a rogue is at work, and watches the memory."""

    def attacked_by(self, process):
        self.process, self.memory = process, []

    def batch_condition(self):
        return self.process.poll() is None

    def batch_end(self):
        if self.batch_id % 10 == 1:
            self.memory.append(memory())


@pytest.mark.parametrize("frames", COUNTS)
def test_fuzzed_frames_of_unauthenticated_connections_are_harmless(
    rogue, port, frames, record_property
):
    config = EnvironmentConfig(f"{ENVS}:Unhurried", num_clients=2, port=port, seed=1, timeout=20.0)
    with WhileAttacked(config, batch_nb=1, batch_size=16) as pipeline:
        pipeline.attacked_by(rogue(port, 0, frames, seed=frames))
        pipeline.execute()
        made, watched = pipeline.batch_id, pipeline.memory
        folder = pipeline.session.dataset_dir
    report = report_of(pipeline.process)
    growth = max(watched) - watched[0]
    record_property("report", {**report, "batches": made, "growth": growth})
    assert report["frames"] == frames
    assert growth < 50 * MEGABYTE
    with Dataset.open(folder) as dataset:
        assert dataset.verify() == []
        check_rows(dataset["training"], 16 * made, instances=2)


def check_rows(rows, count, instances):
    assert count > 0
    number = np.arange(count)
    assert np.array_equal(rows["env_id"][:], number % instances + 1)
    assert np.array_equal(rows["step"][:], number // instances)
    assert np.array_equal(rows["x"][:], np.stack([rows["env_id"][:], rows["step"][:]], axis=1))


# After authentication ---------------------------------------------------------------------------


class Tolerant:
    """Services that take whatever arrives, and count it."""

    def __init__(self):
        self.predicted = self.kept = self.loaded = self.shown = 0

    def predict(self, fields):
        self.predicted += 1
        return {"y": np.zeros(2)}

    def save_parameters(self, instance_id, values):
        assert all(type(name) is str for name in values)
        self.kept += 1

    def load_parameters(self, instance_id):
        self.loaded += 1
        return {"loaded": self.loaded}

    def show(self, instance_id, step, events):
        assert all(event.action in ("add", "update", "remove") for event in events)
        self.shown += 1


class Attacked:
    """A server with honest clients in some places, and rogues in the places behind them.

    It grants rows, checks what arrives, and gives the place of a rogue that is lost to the next.
    """

    def __init__(self, port, honest, rogues):
        config = EnvironmentConfig(f"{ENVS}:Plain", num_clients=honest + rogues, port=port)
        self.services = Tolerant()
        self.server = ClientGroup(config, self.services, [1], ParameterSets(config, [1])).server
        self.honest = range(1, honest + 1)
        self.rogues = range(honest + 1, honest + rogues + 1)
        self.rows = dict.fromkeys([*self.honest, *self.rogues], 0)
        self.cut_off = 0
        self.longest = 0.0

    def turn(self):
        began = time.monotonic()
        self.server.pump(0.05)
        self.longest = max(self.longest, time.monotonic() - began)
        for number, peer in list(self.server.peers.items()):
            if number in self.honest:
                assert peer.finished or not peer.closed, peer.violation
            self.take_rows(number, peer)
            if peer.closed or peer.failure or peer.finished:
                self.lose(number, peer)
            elif peer.fields and peer.granted - peer.received < 5:
                peer.granted = peer.wanted = peer.received + 20  # it waits for every row
                peer.send(pack(Kind.CREDIT, number=peer.granted))

    def take_rows(self, number, peer):
        count = peer.rows.count
        if not count:
            return
        rows = {f.name: np.empty((count, *f.shape), f.dtype) for f in peer.row_fields}
        assert peer.rows.take(count, rows, 0, 1) == count
        assert (rows["env_id"] == number).all()
        assert np.isfinite(rows["x"]).all()
        if number in self.honest:
            steps = np.arange(self.rows[number], self.rows[number] + count)
            assert np.array_equal(rows["step"], steps)
            assert np.array_equal(rows["x"][:, 1], steps)
        else:
            assert (rows["flag"].view(np.uint8) <= 1).all()
        self.rows[number] += count

    def lose(self, number, peer):
        if number in self.rogues:
            self.cut_off += bool(peer.violation)
            self.server.vacate(number)
            del self.server.peers[number]  # the next one begins anew

    def run_until(self, condition):
        deadline = time.monotonic() + 60
        while not condition():
            self.turn()
            assert time.monotonic() < deadline

    def made_after(self, before):
        return all(self.rows[number] > before[number] + 10 for number in self.honest)


@contextlib.contextmanager
def honest_clients(port, numbers):
    command = [sys.executable, "-m", "physx_core.workers", "--connect", f"127.0.0.1:{port}"]
    processes = [subprocess.Popen([*command, "--instance", str(number)]) for number in numbers]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


@pytest.mark.parametrize("frames", COUNTS)
def test_fuzzed_frames_of_client_do_not_affect_others(rogue, port, frames, record_property):
    attacked = Attacked(port, honest=2, rogues=2)
    server = attacked.server
    server.open()
    with contextlib.closing(server), honest_clients(port, attacked.honest) as clients:
        attacked.run_until(lambda: attacked.made_after(dict.fromkeys(attacked.honest, 0)))
        watched = [memory()]
        processes = [rogue(port, n, frames // 2, seed=n) for n in attacked.rogues]
        while any(process.poll() is None for process in processes):
            attacked.turn()
            watched.append(memory())
        before = dict(attacked.rows)
        attacked.run_until(lambda: attacked.made_after(before))  # the run goes on
        server.end()
        attacked.run_until(lambda: all(server.peers[n].finished for n in attacked.honest))
        assert [client.wait(60) for client in clients] == [0, 0]
    reports = [report_of(process) for process in processes]
    services, growth = attacked.services, max(watched) - watched[0]
    record_property(
        "report",
        {
            "rogues": reports,
            "rows": attacked.rows,
            "cut off": attacked.cut_off,
            "longest turn": attacked.longest,
            "growth": growth,
            "asked": (services.predicted, services.kept, services.loaded, services.shown),
        },
    )
    assert sum(report["frames"] for report in reports) == frames // 2 * 2
    assert attacked.cut_off > frames // 50
    assert min(services.predicted, services.kept, services.loaded, services.shown) > 0
    assert all(attacked.rows[number] > 0 for number in attacked.rogues)
    assert attacked.longest < 5
    assert growth < 100 * MEGABYTE
