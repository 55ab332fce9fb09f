"""Frames, handshake, launcher: strangers, wrong tokens, ports, and what a client process sees."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physx_core.config import EnvironmentConfig
from physx_core.errors import (
    ClientError,
    ConfigError,
    ConnectionRefusedByPeerError,
    FieldShapeError,
    UnknownOptionError,
    UsageError,
)
from physx_core.sources.clients import ClientSource
from physx_core.transport.client import run_client
from physx_core.transport.failures import decode_error, encode_error
from physx_core.transport.frames import HEADER, FrameReader, Kind, pack
from physx_core.transport.handshake import introduce
from physx_core.transport.launcher import ClientProcess, stop

ENVS = f"{Path(__file__).parent / 'transport_envs.py'}:"


class Services:
    """Keeps parameters and drawings."""

    def __init__(self):
        self.kept, self.shown = {}, []

    def predict(self, fields):
        raise UsageError("no network")

    def save_parameters(self, instance_id, values):
        self.kept[instance_id] = values

    def load_parameters(self, instance_id):
        return self.kept.get(instance_id, {})

    def show(self, instance_id, step, events):
        self.shown.append((instance_id, step, events))


def source(name="Plain", services=None, **options):
    ahead = options.pop("run_ahead", None)
    config = EnvironmentConfig(ENVS + name, **options)
    return ClientSource(config, services or Services(), [3], run_ahead=ahead)


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


# Frames -----------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from(Kind), st.binary(max_size=300), st.integers(0, 2**64 - 1))),
    st.lists(st.integers(1, 200), min_size=1),
)
def test_frames_arrive_whole_however_they_are_cut(frames, cuts):
    here, there = socket.socketpair()
    with here, there:
        there.setblocking(False)
        reader, received = FrameReader(300), []
        data = b"".join(pack(*frame) for frame in frames)
        turn = 0
        while data:
            size = cuts[turn % len(cuts)]
            here.sendall(data[:size])
            data, turn = data[size:], turn + 1
            while (frame := reader.read(there)) is not None:
                received.append((frame.kind, bytes(frame.payload), frame.number))
        assert received == frames
        here.close()
        with pytest.raises(EOFError):
            reader.read(there)


def test_large_frames_arrive_between_small_ones():
    here, there = socket.socketpair()
    with here, there:
        large = np.arange(300_000).tobytes()
        data = [b"a", large, b"", large[:40_000], b"z"]
        sender = threading.Thread(
            target=lambda: [here.sendall(pack(Kind.ROWS, part)) for part in data]
        )
        sender.start()
        reader = FrameReader(1 << 30)
        assert [bytes(reader.read(there).payload) for _ in data] == data
        sender.join()
        assert not reader.may_have_more


@pytest.mark.parametrize("header", [(11, 1, 0, 0), (5, 99, 0, 0), (5, 1, 1, 0)])
def test_a_bad_header_is_refused_before_anything_is_allocated(header):
    here, there = socket.socketpair()
    with here, there:
        here.sendall(HEADER.pack(*header))
        with pytest.raises(ConnectionRefusedByPeerError, match="no message of physx"):
            FrameReader(10).read(there)


# Errors -----------------------------------------------------------------------------------------


def test_errors_come_back_as_what_they_were():
    error = FieldShapeError("wrong", field="x", instance_id=2, step=5)
    error.add_note("here")
    back = decode_error(encode_error(error))
    assert type(back) is FieldShapeError
    assert str(back) == str(error) == "Instance 2, step 5: wrong"
    assert vars(back) == vars(error)
    assert "FieldShapeError" in str(back.__cause__)
    back = decode_error(encode_error(UnknownOptionError("Thing", ["colour"], ["color"])))
    assert type(back) is UnknownOptionError
    assert (back.owner, back.unknown, back.known) == ("Thing", ["colour"], ["color"])


class PluginsOwnError(ConfigError):
    """Unknown where the server runs."""


def test_an_error_class_of_a_plugin_comes_back_as_its_base():
    error = PluginsOwnError("mine")
    error.thing = object()
    back = decode_error(encode_error(error))
    assert type(back) is ConfigError
    assert str(back) == "mine"
    assert vars(back) == {}


# Strangers --------------------------------------------------------------------------------------


def test_strangers_do_not_disturb_a_run():
    port = free_port()
    stop_it = threading.Event()
    talked = []

    def stranger(first, listen):
        while not stop_it.is_set():
            try:
                with socket.create_connection(("127.0.0.1", port), timeout=1) as connection:
                    connection.sendall(first)
                    talked.append(1)
                    if listen:
                        connection.recv(1000)
                    else:
                        stop_it.wait(0.3)
            except OSError:
                stop_it.wait(0.01)

    hello = pack(Kind.HELLO, b"physxtcp" + bytes(36))
    strangers = [
        threading.Thread(target=stranger, args=args)
        for args in (
            (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", True),
            (os.urandom(500), True),
            (HEADER.pack(0xFFFFFFFF, 1, 0, 0), True),
            (hello[:20], False),
            (hello, False),
            (hello + pack(Kind.PROOF, bytes(32), 1), True),
            (pack(Kind.ROWS, bytes(100), 5), True),
            (b"", False),
        )
    ]
    for thread in strangers:
        thread.start()
    try:
        with source(num_clients=2, port=port) as clients:
            deadline = time.monotonic() + 0.5
            row = 0
            while time.monotonic() < deadline:
                assert list(clients.batch(2)["x"][:, 1]) == [row, row]
                row += 1
    finally:
        stop_it.set()
        for thread in strangers:
            thread.join()
    assert len(talked) > 8


def test_a_silent_stranger_is_dropped_after_a_while(monkeypatch):
    monkeypatch.setattr("physx_core.transport.server._HANDSHAKE_TIME", 0.2)
    port = free_port()
    with source(port=port) as clients, socket.create_connection(("127.0.0.1", port)) as stranger:
        stranger.settimeout(2)
        stranger.sendall(b"\0")
        for _ in range(30):
            clients.batch(1)
            time.sleep(0.02)
        assert stranger.recv(10) == b""


def test_many_silent_strangers_do_not_keep_clients_out():
    port = free_port()
    with source(port=port, num_clients=1) as clients:
        crowd = []
        for _ in range(50):
            crowd.append(socket.create_connection(("127.0.0.1", port), timeout=2))
            clients.batch(1)
            time.sleep(0.011)
        assert crowd[0].recv(10) == b""
        for connection in crowd:
            connection.close()
        clients.batch(1)


def test_a_client_with_another_token_is_told_so():
    port = free_port()
    errors = []

    def join():
        with pytest.raises(ConnectionRefusedByPeerError) as caught:
            run_client(f"127.0.0.1:{port}", "wrong" * 10)
        errors.append(str(caught.value))

    with source(port=port) as clients:
        thread = threading.Thread(target=join)
        thread.start()
        while thread.is_alive():
            clients.batch(1)
            time.sleep(0.011)
    assert "does not know this client's token" in errors[0]
    assert "PHYSX_TOKEN" in errors[0]


def test_a_client_does_not_trust_a_server_without_the_token():
    answers = [
        b"",
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        pack(Kind.CHALLENGE, b"physxtcp" + (1).to_bytes(4, "little") + bytes(64)),
        pack(Kind.CHALLENGE, b"physxtcp" + (9).to_bytes(4, "little") + bytes(64)),
        pack(Kind.SETUP, bytes(50)),
        pack(Kind.CHALLENGE, b"x"),
    ]
    for answer in answers:
        here, there = socket.socketpair()
        with here, there:
            there.sendall(answer)
            if not answer:
                there.close()
            with pytest.raises(ConnectionRefusedByPeerError):
                introduce(here, "token" * 5, 1)


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense", "127.0.0.1:port", "a.invalid:80"])
def test_nothing_at_the_address_is_an_error_that_names_it(address):
    with pytest.raises(ConnectionRefusedByPeerError, match=address):
        run_client(address, "token" * 5)


def test_a_port_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with (
            pytest.raises(ConfigError, match=rf"127\.0\.0\.1 port {port}.*port=0"),
            source(port=port),
        ):
            pass


def test_an_address_of_another_machine_is_named():
    with pytest.raises(ConfigError, match=r"192\.0\.2\.1"), source(ip_address="192.0.2.1"):
        pass


def test_all_addresses_of_the_machine_can_be_listened_at():
    with source(ip_address="0.0.0.0") as clients:
        assert clients.batch(1)["step"] == [0]


# Client processes -------------------------------------------------------------------------------


def test_what_a_client_process_sees(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    services = Services()
    with source("Surroundings", services):
        pass
    seen = services.kept[1]
    assert seen["client"] == "1"
    assert seen["token"] is None
    assert seen["threads"] == "1"
    assert seen["directory"] == str(Path.cwd())
    assert b"--instance\x001" in seen["command"]
    assert not [name for name in seen["modules"] if name.startswith(("physx_core.cli", "h5py"))]
    assert "physx_core.pipelines" not in seen["modules"]
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with source("Surroundings", services):
        assert services.kept[1]["threads"] == "2"


def test_the_token_is_not_on_the_command_line():
    process = ClientProcess(1, "127.0.0.1:1", "very secret token")
    process.start()
    try:
        command = Path(f"/proc/{process.pid}/cmdline").read_bytes()
    finally:
        stop([process], 5.0)
    assert b"secret" not in command


def test_stop_ends_what_ignores_a_polite_signal(tmp_path):
    script = tmp_path / "stubborn.py"
    script.write_text(
        "import signal, time\n"
        "from physx_core import Environment\n"
        "class Stubborn(Environment):\n"
        "    def create(self):\n"
        "        signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "        self.save_parameters(ready=True)\n"
        "        time.sleep(60)\n"
    )
    began = time.monotonic()
    services = Services()
    services.save_parameters = lambda *args: (_ for _ in ()).throw(KeyboardInterrupt)
    config = EnvironmentConfig(f"{script}:Stubborn")
    with pytest.raises(KeyboardInterrupt), ClientSource(config, services, [0]):
        pass
    assert time.monotonic() - began < 20


HAND = """
import os, sys, time
from physx_core.errors import PhysxError
from physx_core.transport.client import run_client
for _ in range(500):
    try:
        status = run_client(sys.argv[1], os.environ["PHYSX_TOKEN"])
    except PhysxError:
        time.sleep(0.02)
    else:
        sys.exit(status)
"""


@contextlib.contextmanager
def hands(count, port):
    """Start clients that connect once a server listens."""
    command = [sys.executable, "-c", HAND, f"127.0.0.1:{port}"]
    processes = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_clients_started_by_hand_join_with_the_token(monkeypatch):
    monkeypatch.setenv("PHYSX_TOKEN", "a token for this test")
    port = free_port()
    config = EnvironmentConfig(ENVS + "Plain", num_clients=2, port=port, timeout=20.0)
    with hands(2, port) as processes:
        with ClientSource(config, Services(), [0], launch=False) as clients:
            batch = clients.batch(6)
        assert [process.wait(10) for process in processes] == [0, 0]
    assert list(batch["env_id"]) == [1, 2] * 3
    assert list(batch["step"]) == [0, 0, 1, 1, 2, 2]


def test_a_client_that_was_started_by_hand_and_ends_is_named(monkeypatch):
    monkeypatch.setenv("PHYSX_TOKEN", "a token for this test")
    port = free_port()
    config = EnvironmentConfig(ENVS + "Plain", port=port, timeout=20.0)
    with (
        hands(1, port) as processes,
        pytest.raises(ClientError, match="Client 1 closed the connection"),
        ClientSource(config, Services(), [0], launch=False) as clients,
    ):
        clients.batch(1)
        processes[0].kill()
        while True:
            clients.batch(1)


def test_clients_started_by_hand_need_a_token(monkeypatch):
    monkeypatch.delenv("PHYSX_TOKEN", raising=False)
    config = EnvironmentConfig(ENVS + "Plain")
    with (
        pytest.raises(ConfigError, match="PHYSX_TOKEN"),
        ClientSource(config, Services(), [0], launch=False),
    ):
        pass


def test_a_client_without_a_place_is_told_so(monkeypatch):
    monkeypatch.setenv("PHYSX_TOKEN", "a token for this test")
    port = free_port()
    config = EnvironmentConfig(ENVS + "Plain", port=port, timeout=20.0)
    errors = []

    def join():
        for wanted in (None, 1, 2):
            with pytest.raises(ConnectionRefusedByPeerError) as caught:
                run_client(f"127.0.0.1:{port}", "a token for this test", wanted)
            errors.append(str(caught.value))

    with hands(1, port), ClientSource(config, Services(), [0], launch=False) as clients:
        thread = threading.Thread(target=join)
        thread.start()
        while thread.is_alive():
            clients.batch(1)
            time.sleep(0.011)
    assert ["no place for instance" in error for error in errors] == [True] * 3


SERVER = """
import sys, time
from pathlib import Path
from physx_core.config import EnvironmentConfig
from physx_core.sources.clients import ClientSource

class Services:
    def predict(self, fields): return fields
    def save_parameters(self, instance_id, values): pass
    def load_parameters(self, instance_id): return {{}}
    def show(self, instance_id, step, events): pass

config = EnvironmentConfig({environment!r}, env_kwargs={kwargs!r}, num_clients=2)
with ClientSource(config, Services(), [0]) as source:
    Path("ready").write_text(source.batch(2) and "yes")
    while True:
        source.batch(2)
"""


def start_server(name, **kwargs):
    Path("server.py").write_text(SERVER.format(environment=ENVS + name, kwargs=kwargs))
    server = subprocess.Popen(
        [sys.executable, "server.py"], stderr=subprocess.PIPE, start_new_session=True
    )
    deadline = time.monotonic() + 20
    while not Path("ready").exists():
        assert server.poll() is None, server.stderr.read().decode()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return server


def children_of(parent):
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = stat.read_text()
        except OSError:
            continue
        if int(text.rpartition(")")[2].split()[1]) == parent:
            found.append(int(stat.parent.name))
    return found


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def gone_after(pids, seconds):
    deadline = time.monotonic() + seconds
    while any(map(alive, pids)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not any(map(alive, pids))


def test_ctrl_c_ends_server_and_clients():
    server = start_server("Walk", delay=0.01)
    clients = children_of(server.pid)
    assert len(clients) == 2
    os.killpg(server.pid, signal.SIGINT)
    error = server.communicate(timeout=10)[1].decode()
    assert error.strip().endswith("KeyboardInterrupt")
    assert gone_after(clients, 0.1)


@pytest.mark.parametrize("name", ["Walk", "Trouble"])
def test_clients_end_when_their_server_is_killed(name):
    # Trouble: within a step that takes a minute
    kwargs = {"what": "sleep", "at": 2} if name == "Trouble" else {}
    server = start_server(name, **kwargs)
    clients = children_of(server.pid)
    assert len(clients) == 2
    server.kill()
    server.communicate()
    assert gone_after(clients, 2.5)
