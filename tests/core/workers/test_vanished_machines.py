"""Machines whose cable is pulled: nobody says goodbye, and nobody waits for long."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from physx_core.net import poll_peer, prepare_connection

pytestmark = pytest.mark.processes

TOKEN = "a token for these tests"
CLIENT = [sys.executable, "-m", "physx_core", "client"]
WANDERER = f"{(Path(__file__).parents[1] / 'programs' / 'restart_envs.py')}:Wanderer"
SOON = 20.0


@contextlib.contextmanager
def connected():
    """Two ends of a connection on this machine."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        near = socket.create_connection(listener.getsockname())
        far, _ = listener.accept()
        with near, far:
            yield near, far


def test_tcp_keepalive_detects_dead_connection_in_time():
    with connected() as (near, _):
        prepare_connection(near)
        assert near.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        options = (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)
        idle, interval, count = (near.getsockopt(socket.IPPROTO_TCP, one) for one in options)
        assert idle + interval * count < SOON
    one, other = socket.socketpair()
    with one, other:
        prepare_connection(one)  # it is not TCP


@pytest.mark.slow
@pytest.mark.faults
def test_slow_reader_is_not_taken_for_dead():
    with connected() as (near, far):
        prepare_connection(near)
        near.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                near.send(bytes(1 << 16))
        poll = select.poll()
        poll.register(near, select.POLLOUT)
        assert not poll_peer(poll, near, 2 * SOON)
        far.settimeout(0.5)
        with contextlib.suppress(TimeoutError):
            while far.recv(1 << 20):
                continue
        assert poll_peer(poll, near, SOON)


@pytest.mark.slow
@pytest.mark.faults
def test_network_loss_restarts_client_with_same_rows(
    local, clients, another_machine, monkeypatch, port, caplog
):
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)
    settings = {"num_clients": 2, "env_kwargs": {"pace": 0.002}}
    with local(WANDERER, **settings) as source:
        expected = source.batch(400)["position"].copy()
    here = another_machine.address

    def join(*prefix):
        command = [*prefix, *CLIENT, "--connect", f"{here}:{port}"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        stack.callback(process.communicate)
        stack.callback(process.kill)
        return process

    def join_once_lost():
        while not any("no longer answers" in text for text in caplog.messages):
            time.sleep(0.1)
        late.append(join())

    late = []
    with contextlib.ExitStack() as stack:
        far = join(*another_machine.prefix)
        near = join()
        source = clients(
            WANDERER, launcher="physx/manual", ip_address=here, port=port, run_ahead=2, **settings
        )
        with source:
            rows = [source.batch(1)["position"][0].copy() for _ in range(200)]
            another_machine.unplug()
            pulled = time.monotonic()
            joined = threading.Thread(target=join_once_lost)
            joined.start()
            rows += [source.batch(1)["position"][0].copy() for _ in range(200)]
            took = time.monotonic() - pulled
            joined.join()
            assert far.wait(max(pulled + SOON - time.monotonic(), 0.1)) == 1
            assert "the server is gone" in far.stdout.read()
        assert (near.wait(60), late[0].wait(60)) == (0, 0)
    assert took < SOON, os.linesep.join(caplog.messages)
    assert [row.tobytes() for row in rows] == [row.tobytes() for row in expected]
    (lost,) = [text for text in caplog.messages if "no longer answers" in text]
    assert "The run waits up to 60 s for another client to take its place" in lost
