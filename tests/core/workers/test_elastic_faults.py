"""Elastic runs: clients and workers that break, in each way; the rows are the same, or it is said.

A client is lost with its workers, and others take over; a worker that breaks is started again.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from physx_core.errors import (
    ClientError,
    ConnectionRefusedByPeerError,
    EnvironmentFailedError,
    TooFewClientsError,
)
from physx_core.net import Kind, encode, pack
from physx_core.workers.client.joining import join as join_run

pytestmark = pytest.mark.processes

PROGRAMS = Path(__file__).parents[1] / "programs"
WANDERER = f"{PROGRAMS / 'restart_envs.py'}:Wanderer"
TOKEN = "a token for these tests"
HOST = socket.gethostname()
HOW = {"kill": "was killed by signal 9", "stop": "sent nothing for", "leave": "ended with"}
WORKER = rf"The worker of instance 2 \(client [12] on {HOST}\)"


# Clients ----------------------------------------------------------------------------------------


def test_killed_elastic_client_is_restarted_by_launcher(local, clients, process_ids, taking, said):
    settings = {"num_clients": 4, "env_kwargs": {"pace": 0.003}}
    options = {"min_clients": 2, "max_clients": 2, "restarts": 1, "run_ahead": 2}
    with clients(WANDERER, **options, **settings) as source:
        rows = taking(source)
        rows.take(40)
        os.kill(process_ids()[2], signal.SIGKILL)
        rows.take(120)
        assert set(process_ids()) == {1, 2}
    rows.check(local(WANDERER, **settings))
    (text,) = said()
    assert text.startswith(f"Client 2 on {HOST} was killed by signal 9 (SIGKILL). Instances")
    assert text.endswith("another client takes over. Restart 1 of 1.")


def test_killed_elastic_client_without_restart_ends_run(clients, process_ids, taking):
    settings = {"num_clients": 2, "env_kwargs": {"pace": 0.003}}
    with (
        pytest.raises(
            TooFewClientsError,
            match=r"has 1 client, but needs 2 \(min_clients\), and no more can join. "
            rf"Client 1 on {HOST} was killed .* set EnvironmentConfig.restarts",
        ),
        clients(WANDERER, min_clients=2, run_ahead=2, **settings) as source,
    ):
        rows = taking(source)
        rows.take(6)
        os.kill(process_ids()[1], signal.SIGKILL)
        rows.take(600)


def test_stopped_elastic_client_times_out(local, clients, process_ids, taking, said, unhurried):
    """The client and its workers stop. No instance needs a restart for that."""
    settings = {"num_clients": 3, "env_kwargs": {"pace": 0.003}}
    timeout = unhurried(2.0)
    with clients(WANDERER, max_clients=2, run_ahead=2, timeout=timeout, **settings) as source:
        rows = taking(source)
        rows.take(30)
        rows.take_until(lambda: len(process_ids()) == 2)
        victim = next(pid for pid in process_ids().values() if process_ids(pid))
        for pid in (victim, *process_ids(victim).values()):
            os.kill(pid, signal.SIGSTOP)
        rows.take(60)
    rows.check(local(WANDERER, **settings))
    (text,) = said("another client takes over")
    assert re.search(r"was cut off. It has not answered for \d+ s: it is stopped, or hangs", text)


def test_elastic_client_timeout_at_end_of_run_is_harmless(
    clients, process_ids, taking, said, unhurried
):
    settings = {"num_clients": 2, "max_clients": 1, "timeout": unhurried(2.0)}
    with clients(WANDERER, run_ahead=0, **settings) as source:
        taking(source).take(8)
        (client,) = process_ids().values()
        for pid in (client, *process_ids(client).values()):
            os.kill(pid, signal.SIGSTOP)
    (text,) = said()
    assert re.match(f"Client 1 on {HOST} was cut off. It has not answered for", text)
    assert text.endswith("The run was ending, and it has all its rows.")


def test_elastic_clients_that_cannot_start_end_run_at_once(clients, monkeypatch, said):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with (
        pytest.raises(
            TooFewClientsError,
            match=r"(?s)has 0 clients, but needs 1 .*no more can join.*before it joined",
        ),
        clients(WANDERER, num_clients=2, max_clients=2, restarts=1),
    ):
        pass
    for number in (1, 2):
        how = f"Client {number} ended with exit status 1 before it joined. "
        assert len(said(how + "Restart 1 of 1")) == 1
        assert len(said(how + "It is not restarted")) == 1


@pytest.mark.parametrize(
    ("elastic", "name"),
    [({"min_clients": 4}, rf"client \d on {HOST}"), ({}, r"its client at 127\.0\.0\.1:\d+")],
)
def test_straggler_client_is_reported_once(clients, taking, said, monkeypatch, elastic, name):
    monkeypatch.setattr("physx_core.workers.server.pace._HELD", 0.5)
    environment = f"{PROGRAMS / 'elastic_envs.py'}:Slow"
    with clients(environment, num_clients=4, run_ahead=4, **elastic) as source:
        taking(source).take(*[4] * 40)
    (text,) = said("The run waits for instance")
    pattern = (
        rf"The run waits for instance 3: {name} takes [\d.]+ ms for a row, ([\d.]+) "
        "times as long as the median of the instances"
    )
    assert float(re.match(pattern, text)[1]) > 2


@pytest.mark.slow
@pytest.mark.faults
def test_network_loss_of_elastic_client_is_detected(
    local, by_hand, join, another_machine, port, taking, said
):
    settings = {"num_clients": 3, "env_kwargs": {"pace": 0.002}}
    address = another_machine.address
    far = join(prefix=another_machine.prefix, address=f"{address}:{port}")
    near = join(address=f"{address}:{port}")
    options = {"min_clients": 2, "ip_address": address, "timeout": 60.0, "run_ahead": 2}
    with by_hand(WANDERER, **options, **settings) as source:
        rows = taking(source)
        rows.take(60)
        another_machine.unplug()
        late = threading.Thread(
            target=lambda: (wait_for(said, "no longer answers"), join(address=f"{address}:{port}"))
        )
        late.start()
        rows.take(120)
        late.join()
        assert far.wait(60) == 1
        assert "the server is gone" in far.stdout.read()
    assert near.wait(60) == 0
    rows.check(local(WANDERER, **settings))
    (text,) = said("no longer answers")
    assert re.match(rf"Client \d on {HOST} was lost: its machine no longer answers", text)


def wait_for(said, pattern):
    deadline = time.monotonic() + 60
    while not said(pattern) and time.monotonic() < deadline:
        time.sleep(0.05)


@pytest.mark.parametrize("launcher", ["physx/subprocess", "physx/manual"])
def test_killed_elastic_run_leaves_no_process(join, port, launcher):
    """What the environments started is gone, too, as `nothing_stays_behind` checks."""
    options = {"num-clients": 3, "max-clients": 2, "port": port, "launcher": launcher}
    words = [word for name, value in options.items() for word in (f"--environment.{name}", value)]
    words += ["--environment.env-kwargs", "fault=fail", "place=never", "pace=0.01"]
    command = [sys.executable, "-m", "physx_core", "generate", WANDERER, *map(str, words)]
    run = subprocess.Popen([*command, "--batch-nb", "100000", "--batch-size", "3"])
    by_hand = join() if launcher == "physx/manual" else None
    try:
        deadline = time.monotonic() + 60
        while len(list(Path().glob("started-*"))) < 3 and time.monotonic() < deadline:
            time.sleep(0.05)
    finally:
        run.kill()
        run.wait()
    assert len(list(Path().glob("started-*"))) >= 3
    if by_hand is not None:
        assert by_hand.wait(60) == 1
        assert "the server is gone" in by_hand.stdout.read()


# Workers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["kill", "stop", "leave"])
def test_failed_elastic_worker_is_restarted(local, clients, taking, said, fault, unhurried):
    settings = {"num_clients": 3, "env_kwargs": {"pace": 0.002}}
    timeout = unhurried(2.0) if fault == "stop" else 60.0
    broken = {**settings, "env_kwargs": {"pace": 0.002, "fault": fault, "at": 7}}
    both = {"min_clients": 2, "max_clients": 2}  # to one that joins later a worker would be moved
    with clients(WANDERER, timeout=timeout, restarts=1, **both, **broken) as source:
        rows = taking(source)
        rows.take(60)
    rows.check(local(WANDERER, **settings))
    (text,) = said("Restart 1 of 1")
    assert re.match(f"{WORKER} {HOW[fault]}", text)


def test_elastic_worker_beyond_restart_limit_is_reported_with_host(clients):
    kwargs = {"fault": "kill", "at": 7}
    with (
        pytest.raises(ClientError, match=f"{WORKER} {HOW['kill']}") as caught,
        clients(WANDERER, num_clients=3, max_clients=2, env_kwargs=kwargs) as source,
    ):
        source.batch(60)
    assert caught.value.instance_id == 2
    assert re.fullmatch(rf"client [12] on {HOST}", caught.value.client)
    assert caught.value.exit_status == -signal.SIGKILL


def test_environment_error_ends_elastic_run(clients):
    kwargs = {"fault": "fail", "at": 3}
    with (
        pytest.raises(EnvironmentFailedError, match="no more beans"),
        clients(WANDERER, num_clients=3, max_clients=2, env_kwargs=kwargs) as source,
    ):
        source.batch(30)


# Broken and wrong messages ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (pack(Kind.HOST, encode("a host\nthat writes lines")), "name of its machine"),
        (pack(Kind.HOST, encode(7)), "name of its machine"),
        (pack(Kind.ENDED, encode({"status": "bad", "stderr": ""}), 1), "how a worker ended"),
        (pack(Kind.ENDED, b"\xff", 1), ""),
        (pack(Kind.ROWS, b"", 3), "It sent ROWS"),
        (pack(Kind.PING, bytes(1 << 17)), "not a physx message"),
        (b"\xff" * 100, "not a physx message"),
    ],
)
def test_protocol_violation_disconnects_elastic_client(
    by_hand, join, port, taking, said, message, text
):
    join("--instance", "1")
    with by_hand(WANDERER, num_clients=2, max_clients=2) as source:
        rows = taking(source)
        rows.take(2)
        rogue = threading.Thread(target=send_rudely, args=(port, message))
        rogue.start()
        rows.take_until(lambda: said("was cut off"))
        rogue.join()
        rows.take(2)
    (lost,) = said("was cut off")
    assert lost.startswith("Client 2 on ")
    assert text in lost


def send_rudely(port, message):
    link, setup = join_run(f"127.0.0.1:{port}", TOKEN, 0)
    assert setup is None
    link._over.set()  # so that the end of the connection does not end this process
    link.send(message)
    with contextlib.suppress(BaseException):
        while True:
            link.receive()
    link.close()


def test_a_worker_without_a_valid_ticket_is_refused(by_hand, join, port, taking):
    join()
    refused = []

    def try_in():
        for ticket in ((2 << 32) + 1, (1 << 32) + 3, 1 << 32):
            try:
                link, _ = join_run(f"127.0.0.1:{port}", TOKEN, ticket, patience=0.0)
            except ConnectionRefusedByPeerError as error:
                refused.append(str(error))
            else:
                link._over.set()
                link.close()

    with by_hand(WANDERER, num_clients=2, max_clients=1) as source:
        rows = taking(source)
        rows.take(2)
        rogue = threading.Thread(target=try_in)
        rogue.start()
        rows.take_until(lambda: not rogue.is_alive())
    assert len(refused) == 3
