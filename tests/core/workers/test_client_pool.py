"""ClientPool: after anything that happens to clients, each instance waits or runs in one place."""

from __future__ import annotations

import time

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from sizes import size

from physx_core import EnvironmentConfig
from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.net import Kind, encode
from physx_core.net.frames import HEADER, Frame, FrameReader
from physx_core.workers.launchers import ManualLauncher
from physx_core.workers.server.client_pool import ClientPool

INSTANCES, LEAST, MOST = 6, 2, 4
WHICH = st.integers(0, 99)


class FakePeer:
    """A connection that keeps what it is sent."""

    def __init__(self):
        self.reader, self.name = FrameReader(256), "127.0.0.1:1"
        self.client, self.closed, self.finished = 0, False, False
        self.offense, self.has_vanished = "", False
        self.sent = []

    def send(self, message):
        _, kind, _, number = HEADER.unpack_from(message)
        self.sent.append((Kind(kind), number))

    def close(self):
        self.closed = True


class PoolMachine(RuleBasedStateMachine):
    """The model: which clients are ready, and which tickets each was told to run and still runs."""

    def __init__(self):
        super().__init__()
        options = {"num_clients": INSTANCES, "min_clients": LEAST, "max_clients": MOST}
        self.pool = ClientPool(EnvironmentConfig("toy/spring", **options), ManualLauncher())
        self.joined, self.ready = [], []
        self.workers = {}
        for worker in self.pool.launch(range(1, INSTANCES + 1), "", ""):
            self.workers[worker.instance_id] = worker

    # What may happen ------------------------------------------------------------------------

    @rule()
    def somebody_joins(self):
        peer = FakePeer()
        if len(self.joined) + len(self.ready) == MOST:
            with pytest.raises(ConnectionRefusedByPeerError, match="at most 4 may join"):
                self.pool.admit(peer, 0)
            assert [kind for kind, _ in peer.sent] == [Kind.ERROR]
            return
        self.pool.admit(peer, 0)
        self.joined.append(peer)

    @precondition(lambda self: self.joined)
    @rule(which=WHICH)
    def a_client_gets_ready(self, which):
        peer = self.joined.pop(which % len(self.joined))
        self.pool.take(peer, Frame(Kind.HOST, 0, bytearray(encode("somewhere"))))
        self.ready.append(peer)

    @precondition(lambda self: self.joined or self.ready)
    @rule(which=WHICH)
    def a_client_is_lost(self, which):
        everybody = self.joined + self.ready
        peer = everybody[which % len(everybody)]
        (self.joined if peer in self.joined else self.ready).remove(peer)
        running = {n for n, worker in self.workers.items() if peer is peer_of(worker)}
        peer.close()
        moved = self.pool.check(time.monotonic(), time.monotonic())
        assert set(moved) == running
        self.relaunch(moved)

    @precondition(lambda self: any(worker.client for worker in self.workers.values()))
    @rule(which=WHICH)
    def a_worker_ends(self, which):
        running = [worker for worker in self.workers.values() if worker.client]
        worker = running[which % len(running)]
        end = bytearray(encode({"status": 3, "stderr": "last words"}))
        self.pool.take(peer_of(worker), Frame(Kind.ENDED, worker.ticket, end))
        assert (worker.exit_status(), worker.stderr()) == (3, "last words")
        self.relaunch([worker.instance_id])

    @rule(made=st.just(0) | st.integers(0, 50), left=st.none() | st.integers(0, 50))
    def loads_are_balanced(self, made, left):
        before = self.loads()
        while (number := self.pool.find_move(lambda number: (made, left))) is not None:
            assert max(before) - min(before) >= 2
            worker = self.workers[number]
            worker.kill()
            assert peer_of(worker).sent[-1] == (Kind.STOP, worker.ticket)
            self.relaunch([number])
        if made == 0 and len(self.ready) > 1 and not self.waiting():
            assert max(self.loads()) - min(self.loads()) <= 1

    def relaunch(self, numbers):
        for worker in self.pool.launch(numbers, "", ""):
            former = self.workers[worker.instance_id]
            assert worker.ticket > former.ticket
            with pytest.raises(ConnectionRefusedByPeerError):
                self.pool.redeem(former.ticket)
            self.workers[worker.instance_id] = worker

    # What always holds ----------------------------------------------------------------------

    def waiting(self):
        return {number for number in self.workers if self.pool.waits(number)}

    def loads(self):
        peers = [peer_of(worker) for worker in self.workers.values()]
        return [peers.count(peer) for peer in self.ready] or [0]

    @invariant()
    def each_instance_is_in_one_place(self):
        for number, worker in self.workers.items():
            assert self.pool.redeem(worker.ticket) == number
            assert self.pool.waits(number) == (worker.client is None)
            if worker.client is not None:
                assert peer_of(worker) in self.ready
                assert (Kind.START, worker.ticket) in peer_of(worker).sent
                assert self.pool.place(number) == f"client {worker.client.number} on somewhere"

    @invariant()
    def nobody_waits_without_a_reason(self):
        if len(self.ready) >= LEAST:
            assert not self.waiting()

    @invariant()
    def numbers_of_clients_are_unique(self):
        numbers = [peer.client for peer in self.joined + self.ready]
        assert len(set(numbers)) == len(numbers)
        assert set(numbers) <= set(range(1, MOST + 1))


def peer_of(worker):
    return worker.client.peer if worker.client is not None else None


PoolMachine.TestCase.settings = settings(max_examples=size(60, 7), stateful_step_count=30)
test_any_history = PoolMachine.TestCase
