"""What an episode of a campaign is: random streams by number, the rows of `Troubled`, and results.

Nothing of this uses what it is compared with.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np

from physx_core.dataset import EpisodeStatus
from physx_core.net.link import SOCKETS
from physx_core.sources import ClientSource, LocalSource

ENVS = Path(__file__).parents[1] / "core" / "programs" / "campaign_envs.py"
TROUBLED, UNCHECKED = f"{ENVS}:Troubled", f"{ENVS}:Unchecked"
FAILS = ("raises", "raises early", "raises late", "is not finite", "is rejected")
"""Troubles because of which an episode fails."""


def stream(number, seed):
    """Return NumPy's generator for an episode."""
    key = np.random.SeedSequence(list(seed)).generate_state(2, np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, number]))


def rows_of(number, seed, troubles=None, *, least=0, most=4, width=2, episode_steps=None):
    """Return the rows of an episode of `Troubled`; None if it fails."""
    kind, at = (troubles or {}).get(str(number), ("", 0))
    rng = stream(number, seed)
    count = int(rng.integers(least, most + 1))
    count = at if kind == "is long" else count
    if kind == "raises early":
        return None
    if kind in FAILS and at < count:
        return None
    count = count if episode_steps is None else min(count, episode_steps)
    return [rng.normal(size=width).tolist() for _ in range(count)]


class Results:
    """What a source has simulated.

    Attributes:
        rows: Number of an episode that finished to its rows.
        failed: Number of an episode that failed to the reason.
        parameters: Number to parameters.
        fields: Number to the fields that the episode has once.
        records: All records.
    """

    def __init__(self):
        self.rows, self.failed, self.parameters, self.records = {}, {}, {}, []
        self.fields = {}
        self._parts = {}

    def take_all(self, source, queue):
        """Take what a source simulates until its queue is done; each number ends once."""
        idle = 0
        while not queue.is_done:
            block = source.take()
            idle = 0 if block.records else idle + 1
            assert idle < 10  # nothing to do although something is missing
            self.add(block)
        assert not source.take().records
        return self

    def add(self, block):
        """Add a block."""
        columns = {name: values.tolist() for name, values in block.rows.items()}
        count = len(columns.get("step", ()))
        assert count == sum(record.rows for record in block.records)
        assert not any(columns.get("env_id", ()))
        self.records += block.records
        begin = 0
        for record in block.records:
            end = begin + record.rows
            mine = {name: values[begin:end] for name, values in columns.items()}
            begin = end
            if record.count > 1:
                for row in range(record.count):
                    one = {name: values[row : row + 1] for name, values in mine.items()}
                    self._add(record, record.episode + row, one)
            else:
                self._add(record, record.episode, mine)

    def _add(self, record, number, columns):
        assert number not in self.rows
        assert number not in self.failed
        if record.status is EpisodeStatus.FAILED:
            assert not record.rows
            self.failed[number] = record.reason
            self._parts.pop(number, None)
            return
        if record.part == 0:
            self._parts[number] = []
        parts = self._parts[number]
        assert record.part == len(parts)
        parts.append(columns.get("x", []))
        before = sum(map(len, parts[:-1]))
        assert columns.get("step", []) == list(range(before, before + len(parts[-1])))
        assert columns.get("episode", []) == [number] * len(parts[-1])
        if record.status is EpisodeStatus.FINISHED:
            self.rows[number] = [row for part in self._parts.pop(number) for row in part]
            self.fields[number] = dict(record.fields)
            own = () if record.count == 1 else number - record.episode
            self.parameters[number] = {n: np.asarray(v)[own] for n, v in record.parameters.items()}


@contextlib.contextmanager
def leased(config, seed, queue, services=None, transport=SOCKETS):
    """Simulate the numbers of a queue, in this process or in clients, as configured."""
    if config.as_tcp_ip_client:
        source = ClientSource(config, services, seed, transport=transport)
    else:
        source = LocalSource(config, services, seed)
    with source:
        yield source.lease(queue)
