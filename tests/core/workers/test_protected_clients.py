"""Clients on other machines: what travels is encrypted, and nobody in between is trusted.

The other machine is a network namespace; where a client of this one is enough it uses an address
that is not a loopback one, and its traffic is protected all the same.
"""

from __future__ import annotations

import contextlib
import random
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from physx_core.errors import ConnectionRefusedByPeerError
from physx_core.net import (
    Frame,
    FrameReader,
    Kind,
    PlainRefusedError,
    SecureSocket,
    ServerHandshake,
    encrypt,
    introduce,
    pack,
)
from physx_core.net.tls import Identity
from physx_core.workers.client.worker import run_client

pytestmark = pytest.mark.processes

TOKEN = "a token for these tests"
CLIENT = [sys.executable, "-m", "physx_core", "client"]
WANDERER = f"{(Path(__file__).parents[1] / 'programs' / 'restart_envs.py')}:Wanderer"
PATIENCE = 60.0
HELLO = struct.Struct("<8sI32s")


@pytest.fixture(autouse=True)
def token(monkeypatch):
    monkeypatch.setenv("PHYSX_TOKEN", TOKEN)


@pytest.fixture
def here(another_machine):
    """Our address on the network."""
    return another_machine.address


@pytest.fixture
def join(nothing_stays_behind, token):
    """Start ``physx client`` for an address."""
    with contextlib.ExitStack() as stack:

        def start(address, prefix=()):
            process = subprocess.Popen(
                [*prefix, *CLIENT, "--connect", address],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


class Between:
    """Somebody between client and server: passes on what it receives, and keeps a copy.

    Attributes:
        port: Where it listens.
        sent: What clients sent, and what servers did.
    """

    def __init__(self, host, target, *, meet=lambda connected: connected, reach=None):
        self.listener = socket.create_server((host, 0))
        self.port = self.listener.getsockname()[1]
        self.target, self.meet = target, meet
        self.reach = reach or (lambda connected: connected)
        self.sent = (bytearray(), bytearray())
        self.over = threading.Event()
        self.threads = [threading.Thread(target=self.work)]

    def __enter__(self):
        self.threads[0].start()
        return self

    def __exit__(self, *_):
        self.over.set()
        for thread in self.threads:
            thread.join()
        self.listener.close()

    def work(self):
        while not self.over.is_set():
            if select.select([self.listener], [], [], 0.02)[0]:
                connected, _ = self.listener.accept()
                thread = threading.Thread(target=self.attend, args=[connected])
                self.threads.append(thread)
                thread.start()

    def attend(self, connected):
        with contextlib.suppress(OSError, ConnectionRefusedByPeerError):
            onward = socket.create_connection(self.target, PATIENCE)
            near, far = self.meet(connected), self.reach(onward)
            with near, far:
                self.pass_on(near, far)

    def pass_on(self, near, far):
        ends = (near, far)
        for end in ends:
            end.setblocking(False)
        while not self.over.is_set():
            hidden = [end for end in ends if getattr(end, "hidden", ())]
            for end in hidden or select.select(ends, [], [], 0.05)[0]:
                side = ends.index(end)
                try:
                    data = end.recv(1 << 16)
                except BlockingIOError:
                    continue
                if not data:
                    return
                self.sent[side].extend(data)
                other = ends[1 - side]
                other.settimeout(PATIENCE)
                other.sendall(data)
                other.setblocking(False)


# What can be read on the way ------------------------------------------------------------------


@pytest.mark.slow
def test_tls_hides_token_and_rows_from_eavesdropper(local, clients, here, port, join):
    settings = {"num_clients": 1, "env_kwargs": {"pace": 0.0, "asks": True}}
    with local(WANDERER, **settings) as source:
        expected = source.batch(60)
        expected = {name: values.copy() for name, values in expected.items()}
    recordings = {}
    for address in ("127.0.0.1", here):
        with Between(address, (address, port)) as between:
            client = join(f"{address}:{between.port}")
            with clients(
                WANDERER, launcher="physx/manual", ip_address=address, port=port, **settings
            ) as source:
                batch = source.batch(60)
                for name, values in expected.items():
                    assert batch[name].tobytes() == values.tobytes(), name
            assert client.wait(PATIENCE) == 0
        recordings[address] = b"".join(map(bytes, between.sent))
    readable = [
        b"physxtcp",
        b"restart_envs.py",
        b"position",
        *(row.tobytes() for row in expected["position"][:20]),
    ]
    assert all(text in recordings["127.0.0.1"] for text in readable)  # the recorder can read
    assert not [text for text in readable if text in recordings[here]]
    assert not any(TOKEN.encode() in recording for recording in recordings.values())
    assert between.sent[0][:3] == b"\x16\x03\x01"


def test_tls_client_rows_equal_local_rows_of_any_size(local, clients, here):
    for environment, rows, arguments in (("Walk", 6, {"size": 100_000}), (WANDERER, 200, {})):
        settings = {"num_clients": 2, "env_kwargs": arguments}
        with local(environment, **settings) as source:
            expected = {name: values.copy() for name, values in source.batch(rows).items()}
        with clients(environment, ip_address=here, **settings) as source:
            batch = source.batch(rows)
            peers = source._group.server.peers.values()
            assert all(isinstance(peer.link, SecureSocket) for peer in peers)
            for name, values in expected.items():
                assert batch[name].tobytes() == values.tobytes(), name


def test_local_client_of_public_server_uses_no_tls(clients, another_machine):
    with clients(num_clients=2, ip_address="0.0.0.0") as source:
        source.batch(4)
        peers = source._group.server.peers.values()
        assert [type(peer.link) for peer in peers] == [socket.socket] * 2


def test_forwarded_connections_use_tls(clients, here, port, join):
    settings = {"launcher": "physx/manual", "num_clients": 2, "port": port}
    with (
        Between("127.0.0.1", (here, port)) as to_network,
        Between(here, ("127.0.0.1", port)) as from_network,
    ):
        ours = [join(f"127.0.0.1:{to_network.port}"), join(f"{here}:{from_network.port}")]
        with clients(ip_address="0.0.0.0", **settings) as source:
            source.batch(4)
            peers = source._group.server.peers.values()
            assert all(isinstance(peer.link, SecureSocket) for peer in peers)
        assert [client.wait(PATIENCE) for client in ours] == [0, 0]


# Who must not be trusted ------------------------------------------------------------------------


@pytest.mark.parametrize("onward", ["encrypted", "plain"])
def test_tls_detects_man_in_the_middle(clients, here, port, join, onward):
    """He encrypts to the client with his own, and goes on to the server as he likes."""
    identity = Identity()

    def meet(connected):
        near = SecureSocket.of_server(connected, identity, set())
        near.settimeout(PATIENCE)
        return near

    def reach(connected):
        return encrypt(connected, always=True) if onward == "encrypted" else connected

    # On the server's own machine, where he may be plain.
    target = ("127.0.0.1", port)
    with Between(here, target, meet=meet, reach=reach) as between:
        settings = {"launcher": "physx/manual", "port": port, "ip_address": "0.0.0.0"}
        honest = join(f"{here}:{port}")
        with clients(**settings) as source:
            source.batch(1)
            victim = join(f"{here}:{between.port}")
            while victim.poll() is None:
                source.batch(1)
                time.sleep(0.01)
        assert honest.wait(PATIENCE) == 0
    said = victim.stdout.read()
    assert victim.returncode == 1
    assert "someone in between answers in its place" in said
    reader = FrameReader(1 << 16)
    reader.receive(fed := memory_of(between.sent[0]))
    fed.close()
    assert reader.take().kind is Kind.HELLO  # he read that, as everybody may
    assert reader.take() is None  # and never a proof


def memory_of(data):
    """A socket from which some bytes can be received."""
    one, other = socket.socketpair()
    one.sendall(data)
    one.close()
    return other


def test_remote_client_without_tls_is_refused(clients, here, port):
    with clients(ip_address=here, port=port) as source:

        def talk(*messages):
            """Send messages in plain; return the frames that are answered until the end."""
            frames, reader = [], FrameReader(1 << 16)
            with socket.create_connection((here, port), PATIENCE) as connection:
                for message in messages:
                    connection.sendall(message)
                connection.settimeout(0.01)
                deadline = time.monotonic() + PATIENCE
                while time.monotonic() < deadline:
                    source.batch(1)
                    with contextlib.suppress(TimeoutError):
                        try:
                            frames.append(reader.read(connection))
                        except EOFError as error:
                            if not isinstance(error.__cause__, TimeoutError):
                                return frames
                pytest.fail("it was not dropped")

        hello = pack(Kind.HELLO, HELLO.pack(b"physxtcp", 2, bytes(32)))
        (answer,) = talk(hello, pack(Kind.PROOF, bytes(32), 1))
        assert (answer.kind, answer.number) == (Kind.CHALLENGE, 1)
        assert bytes(answer.payload[-32:]) == bytes(32)  # no proof for somebody who listens
        (answer,) = talk(hello, hello)
        assert talk(pack(Kind.READY, b"{}")) == []
        with socket.create_connection((here, port), PATIENCE) as connection:
            refused = threading.Thread(target=refusal, args=[connection])
            refused.start()
            while refused.is_alive():
                source.batch(1)
                time.sleep(0.01)


def refusal(connection):
    with pytest.raises(PlainRefusedError, match="only encrypted connections"):
        introduce(connection, TOKEN, 0)


def test_tls_downgrade_of_remote_client_is_impossible(here):
    """A server that asks for nothing better, and knows the token, receives no greeting."""
    heard = []
    with socket.create_server((here, 0)) as listener:

        def answer():
            guest, _ = listener.accept()
            with guest:
                heard.append(guest.recv(1 << 16))
                handshake = ServerHandshake(TOKEN)
                hello = Frame(Kind.HELLO, 0, bytearray(HELLO.pack(b"physxtcp", 2, bytes(32))))
                guest.sendall(handshake.answer(hello))

        thread = threading.Thread(target=answer)
        thread.start()
        port = listener.getsockname()[1]
        with pytest.raises(ConnectionRefusedByPeerError, match="same version of physx-core"):
            run_client(f"{here}:{port}", TOKEN, patience=0.1)
        thread.join()
    assert b"physxtcp" not in heard[0]


@pytest.mark.parametrize("place", ["loopback", "network"])
def test_client_version_mismatch_names_both_versions(clients, here, port, place):
    host = here if place == "network" else "127.0.0.1"
    with (
        clients(ip_address=here if place == "network" else "0.0.0.0", port=port) as source,
        socket.create_connection((host, port), PATIENCE) as connection,
    ):
        connection.sendall(pack(Kind.HELLO, HELLO.pack(b"physxtcp", 1, bytes(32))))
        connection.setblocking(False)
        reader, frame = FrameReader(1 << 10), None
        while frame is None:
            source.batch(1)
            frame = reader.read(connection)
        assert HELLO.unpack(frame.payload[:44])[:2] == (b"physxtcp", 2)  # it says so, and ends


# Strangers and faults -------------------------------------------------------------------------


def test_garbage_on_tls_port_is_harmless(local, clients, here, port):
    rng = random.Random(7)
    greeting = record_of_greeting()
    stop, tried = threading.Event(), []

    def attack():
        while not stop.is_set():
            data = bytearray(greeting)
            choice = rng.randrange(4)
            if choice == 0:
                data = bytearray(rng.randbytes(rng.randrange(600)))
            elif choice == 1:
                del data[rng.randrange(len(data)) :]
            elif choice == 2:
                data[rng.randrange(len(data))] ^= rng.randrange(1, 256)
            else:
                data += rng.randbytes(rng.randrange(5000))
            with contextlib.suppress(OSError):
                stranger = socket.create_connection((here, port), 5)
                with stranger:
                    stranger.sendall(data)
                    stranger.settimeout(0.02)
                    with contextlib.suppress(TimeoutError):
                        while stranger.recv(1 << 16):
                            pass
                    tried.append(choice)

    with local(WANDERER, num_clients=2) as source:
        expected = source.batch(2000)["position"].copy()
    thread = threading.Thread(target=attack)
    with clients(WANDERER, num_clients=2, ip_address=here, port=port) as source:
        thread.start()
        try:
            rows = []
            deadline = time.monotonic() + PATIENCE
            while len(rows) < 2000 or len(tried) < 60:
                if len(rows) < 2000:
                    rows += [row.copy() for row in source.batch(20)["position"]]
                else:
                    source._group.server.pump(0.01)
                assert time.monotonic() < deadline
        finally:
            stop.set()
            thread.join()
        assert {0, 1, 2, 3} <= set(tried)
    assert np.array_equal(rows, expected)


def record_of_greeting():
    """What a client that encrypts sends first."""
    one, other = socket.socketpair()
    one.settimeout(0.1)
    with other:
        with pytest.raises(TimeoutError):
            SecureSocket.of_client(one)
        return other.recv(1 << 16)


@pytest.mark.parametrize("who", ["client", "server"])
def test_tls_peer_notices_kill_of_other_side(
    local, clients, here, port, join, another_machine, who, caplog, nothing_stays_behind
):
    settings = {"num_clients": 1, "env_kwargs": {"pace": 0.001}}
    if who == "server":
        program = (
            "import sys, time\n"
            "from physx_core import DataGeneration, EnvironmentConfig\n"
            f"config = EnvironmentConfig({WANDERER!r}, ip_address={here!r}, port={port}, "
            "launcher='physx/manual', env_kwargs={'pace': 0.01})\n"
            "DataGeneration(config, batch_nb=10**6, batch_size=1).execute()\n"
        )
        server = subprocess.Popen([sys.executable, "-c", program], stderr=subprocess.DEVNULL)
        try:
            client = join(f"{here}:{port}", another_machine.prefix)
            while "running" not in client.stdout.readline():
                assert client.poll() is None
        finally:
            server.kill()
            server.wait()
        assert client.wait(PATIENCE) == 1
        assert "the server is gone" in client.stdout.read()
        return
    with local(WANDERER, **settings) as source:
        expected = source.batch(300)["position"].copy()
    first = join(f"{here}:{port}", another_machine.prefix)
    with clients(
        WANDERER, launcher="physx/manual", ip_address=here, port=port, run_ahead=2, **settings
    ) as source:
        rows = [source.batch(1)["position"][0].copy() for _ in range(100)]
        first.send_signal(signal.SIGKILL)
        second = join(f"{here}:{port}", another_machine.prefix)
        rows += [source.batch(1)["position"][0].copy() for _ in range(200)]
    assert second.wait(PATIENCE) == 0
    assert np.array_equal(rows, expected)
    assert any("another client to take its place" in text for text in caplog.messages)
