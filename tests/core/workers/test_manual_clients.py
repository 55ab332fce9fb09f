"""Clients that people start with ``physx client``, here and on other machines, and strangers."""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from physx_core.errors import ClientError, ConfigError
from physx_core.net import Kind, pack

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "worker_envs.py"
WANDERER = f"{(Path(__file__).parents[1] / 'programs' / 'restart_envs.py')}:Wanderer"
TOKEN = "a token for these tests"
CLIENT = [sys.executable, "-m", "physx_core", "client"]


def warnings(caplog):
    return [record.getMessage() for record in caplog.records if record.name == "physx"]


def alive(number):
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def gone_after(numbers, seconds):
    deadline = time.monotonic() + seconds
    while any(map(alive, numbers)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return not any(map(alive, numbers))


# Joining, leaving, taking over ------------------------------------------------------------------


def test_manual_clients_join_waiting_run(by_hand, join, port, caplog):
    ours = [join("--instance", "2"), join()]  # nothing listens yet
    with by_hand(num_clients=2) as source:
        batch = {name: values.copy() for name, values in source.batch(6).items()}
    said = [process.communicate(timeout=60)[0].splitlines() for process in ours]
    assert [process.returncode for process in ours] == [0, 0]
    assert batch["env_id"].tolist() == [1, 2] * 3
    assert said[0][0] == f"physx client: connecting to the server at 127.0.0.1:{port}"
    assert said[0][1].endswith("worker_envs.py:Plain, instance 2 of 2")
    assert said[0][-1] == "physx client: the run has ended"
    assert said[1][1].endswith("instance 1 of 2")
    first = warnings(caplog)[0]
    assert (
        f"The run waits for 2 clients. Start each with: physx client --connect 127.0.0.1:{port}"
        in first
    )
    assert TOKEN not in caplog.text


def test_server_reports_missing_manual_clients(by_hand, caplog, monkeypatch):
    monkeypatch.setattr("physx_core.workers.server.client_group._SAY_EVERY", 0.2)
    with (
        pytest.raises(ClientError, match=r"Client 1 did not connect for 3 s"),
        by_hand(num_clients=2, timeout=3.0),
    ):
        pass
    texts = warnings(caplog)
    assert "has been waiting for a client to run instance 1, 2 for " in texts[1]
    assert "has been waiting for a client to run instance 1, 2 for 3 s" in texts[-1]


def test_manual_client_replaces_one_that_left(local, by_hand, join, caplog):
    settings = {"num_clients": 2, "env_kwargs": {"pace": 0.002, "asks": True}}
    with local(WANDERER, **settings) as source:
        expected = source.batch(60)
    leaver, late = join(), None
    join()
    with by_hand(WANDERER, run_ahead=2, **settings) as source:
        rows = []
        for row in range(60):
            if row == 20:
                leaver.send_signal(signal.SIGINT)
                leaver.wait(60)
                late = join()
            rows.append(source.batch(1)["position"][0].copy())
    assert [row.tobytes() for row in rows] == [row.tobytes() for row in expected["position"]]
    assert leaver.returncode == 130
    said = late.communicate(timeout=60)[0]
    assert "rows are generated again" in said
    (text,) = [text for text in warnings(caplog) if "closed the connection" in text]
    assert "The run waits up to 20 s for another client to take its place" in text


@pytest.mark.slow
def test_missing_manual_client_ends_run_after_timeout(by_hand, join, unhurried):
    client, timeout = join(), unhurried(2.0)
    assert "connecting to the server" in client.stdout.readline()
    with (
        pytest.raises(
            ClientError, match=r"Client 1 was lost after \d+ rows, and no other .* s while"
        ),
        by_hand(timeout=timeout) as source,
    ):
        source.batch(1)
        client.kill()
        while True:
            source.batch(1)


def test_surplus_manual_client_is_refused(by_hand, join):
    join("--instance", "1")
    with by_hand() as source:
        rest = [join(), join("--instance", "1"), join("--instance", "2")]
        while any(process.poll() is None for process in rest):
            source.batch(1)
            time.sleep(0.011)
    for process in rest:
        assert process.returncode == 1
        assert "The server has no place for " in process.stderr.read()


def test_environment_failure_is_reported_on_both_sides(by_hand, join):
    client = join()
    kwargs = {"fault": "fail", "who": 1}
    with pytest.raises(Exception, match="no more beans"), by_hand(WANDERER, env_kwargs=kwargs) as s:
        s.batch(30)
    said = client.communicate(timeout=60)[0]
    assert client.returncode == 1
    assert "EnvironmentFailedError: Instance 1 raised in step() at step 5" in said


def test_manual_client_connection_timeout(join):
    began = time.monotonic()
    client = join("--patience", "0.5")
    error = client.communicate(timeout=30)[1]
    assert client.returncode == 1
    assert "No server can be reached" in error
    assert time.monotonic() - began > 0.5


# Tokens -----------------------------------------------------------------------------------------


def test_token_from_file(clients, join, port, tmp_path, monkeypatch):
    monkeypatch.delenv("PHYSX_TOKEN")
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    file.chmod(0o600)
    client = join("--token-file", str(file))
    options = {"launcher": "physx/manual", "port": port, "token_file": str(file)}
    with clients(**options) as source:
        source.batch(1)
    assert client.wait(60) == 0


@pytest.mark.parametrize(
    ("content", "mode", "text"),
    [
        (TOKEN, 0o640, "Other users can read or write the token file .*chmod 600"),
        (TOKEN, 0o604, "Other users"),
        ("short", 0o600, "has 5 characters: it must have at least 16"),
        (None, 0, "cannot be read"),
    ],
)
def test_token_file_with_wrong_permissions_or_content_is_refused(
    clients, join, tmp_path, content, mode, text
):
    file = tmp_path / "token"
    if content is not None:
        file.write_text(content)
        file.chmod(mode)
    with pytest.raises(ConfigError, match=text), clients(token_file=str(file)):
        pass
    client = join("--token-file", str(file))
    assert text[:10] in client.communicate(timeout=30)[1].replace("\n", " ")
    assert client.returncode == 1


def test_manual_clients_and_public_addresses_require_token(clients, monkeypatch):
    monkeypatch.delenv("PHYSX_TOKEN", raising=False)
    with pytest.raises(ConfigError, match="PHYSX_TOKEN"), clients(launcher="physx/manual"):
        pass
    with (
        pytest.raises(ConfigError, match=r"Other machines can reach .*PHYSX_TOKEN"),
        clients(ip_address="0.0.0.0"),
    ):
        pass
    with clients(ip_address="localhost") as source:
        source.batch(1)


def test_client_without_token_is_refused(monkeypatch, port):
    environment = {name: value for name, value in os.environ.items() if name != "PHYSX_TOKEN"}
    command = [*CLIENT, "--connect", f"127.0.0.1:{port}"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "--token-file" in done.stderr


# Strangers --------------------------------------------------------------------------------------


def flood(kind, port, over, opened):
    """Open connections until it is over, and count them."""
    kept = []
    while not over.is_set():
        try:
            kept.append(socket.create_connection(("127.0.0.1", port), timeout=1))
            opened.append(1)
            if kind == "talkative":
                kept[-1].sendall(pack(Kind.HELLO, b"physxtcp" + secrets.token_bytes(36)))
            if kind == "quick" or len(kept) > 200:
                kept.pop(0).close()
        except OSError:
            over.wait(0.01)
    for connection in kept:
        connection.close()


@pytest.mark.parametrize("kind", ["silent", "talkative", "quick"])
def test_connection_flood_does_not_block_late_client(by_hand, join, port, kind):
    """Connections are opened as fast as it goes, and kept or closed at once."""
    over = threading.Event()
    opened = []

    def come_late():
        end = time.monotonic() + 60
        while len(opened) <= 200 and time.monotonic() < end:
            time.sleep(0.01)
        clients.extend(join("--patience", "30") for _ in range(2))

    clients = []
    crowd = [threading.Thread(target=flood, args=(kind, port, over, opened)) for _ in range(2)]
    late = threading.Thread(target=come_late)
    join()
    try:
        with by_hand(num_clients=1) as source:
            source.batch(1)
        for thread in (*crowd, late):
            thread.start()
        with by_hand(num_clients=2, timeout=40.0) as source:
            steps = [step for _ in range(20) for step in source.batch(2)["step"].tolist()]
        assert [client.wait(60) for client in clients] == [0, 0]
    finally:
        over.set()
        for thread in (*crowd, late):
            thread.join()
    assert steps == [step // 2 for step in range(40)]
    assert len(opened) > 200


# The server's death -----------------------------------------------------------------------------

SERVER = f"""
import sys
from pathlib import Path
from physx_core.config import EnvironmentConfig
from physx_core.sources.client_source import ClientSource

class Services:
    def load_parameters(self, instance_id): return {{}}
    def save_parameters(self, instance_id, values): pass

config = EnvironmentConfig(
    {WANDERER!r}, env_kwargs={{"fault": "fail", "place": "never", "pace": float(sys.argv[2])}},
    num_clients=2, port=int(sys.argv[1]), launcher="physx/manual",
)
with ClientSource(config, Services(), [0]) as source:
    source.batch(2)
    Path("ready").touch()
    while True:
        source.batch(2)
"""


@pytest.mark.parametrize("pace", [0.01, 30.0])
def test_manual_clients_exit_when_server_is_killed(join, port, pace):
    """The environments sleep for most of the time, and each has started a process."""
    started = [join(), join(start_new_session=True)]
    server = subprocess.Popen([sys.executable, "-c", SERVER, str(port), str(pace)])
    try:
        deadline = time.monotonic() + 60
        numbers = []
        while len(numbers) < 4 and time.monotonic() < deadline:
            time.sleep(0.05)
            numbers = [n for one in started for n in (one.pid, *children_of(one.pid))]
        assert len(numbers) == 4
        time.sleep(0.5)  # in the middle of steps
    finally:
        server.kill()
        server.wait()
    assert gone_after(numbers, 20.0)
    assert [process.wait(1) for process in started] != [0, 0]


def children_of(parent):
    found = []
    for stat in (folder / "stat" for folder in Path("/proc").glob("[0-9]*")):
        with contextlib.suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[1]) == parent:
                found.append(int(stat.parent.name))
    return found


# Another machine --------------------------------------------------------------------------------


def test_remote_client_needs_token(by_hand, join, port, another_machine):
    prefix, address = another_machine.prefix, another_machine.address
    where = {"prefix": prefix, "address": f"{address}:{port}"}
    strangers = {**os.environ, "PHYSX_TOKEN": "another token than that"}
    loopback = join("--patience", "1", prefix=prefix, address=f"127.0.0.1:{port}")
    friend = join("--instance", "1", **where)
    with by_hand(ip_address=address) as source:
        stranger = join(env=strangers, **where)
        while stranger.poll() is None:
            source.batch(1)
            time.sleep(0.011)
        assert source.batch(1)["env_id"] == [1]
    assert friend.wait(60) == 0
    assert stranger.returncode == 1
    assert "does not know this client's token" in stranger.stderr.read()
    assert loopback.wait(60) == 1  # it is a machine of its own
