"""Client processes: what they see, started by hand, and how they and their server end."""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from physx_core.errors import ConfigError, ConnectionRefusedByPeerError
from physx_core.workers.client.worker import run_client
from physx_core.workers.launchers import ClientProcess, stop

pytestmark = pytest.mark.processes

ENVS = Path(__file__).parents[1] / "programs" / "worker_envs.py"


def test_environment_variables_of_client_process(clients, services, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with clients("Surroundings"):
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
    with clients("Surroundings"):
        assert services.kept[1]["threads"] == "2"


@pytest.mark.slow
def test_the_token_is_not_on_the_command_line():
    process = ClientProcess(1, "127.0.0.1:1", "very secret token")
    process.start()
    try:
        command = Path(f"/proc/{process.pid}/cmdline").read_bytes()
    finally:
        stop([process], 5.0)
    assert b"secret" not in command


def test_client_that_ignores_sigterm_is_killed(clients, services, tmp_path):
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
    services.save_parameters = lambda *args: (_ for _ in ()).throw(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt), clients(f"{script}:Stubborn"):
        pass
    assert time.monotonic() - began < 20


HAND = """
import os, sys, time
from physx_core.errors import PhysxError
from physx_core.workers.client.worker import run_client
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


@pytest.fixture
def by_hand(clients, monkeypatch, port):
    """Return a source that waits at the port for clients with the token."""
    monkeypatch.setenv("PHYSX_TOKEN", "a token for this test")
    return functools.partial(clients, "Plain", launcher="physx/manual", port=port, timeout=20.0)


def test_manual_clients_join_with_token(by_hand, port):
    with hands(2, port) as processes:
        with by_hand(num_clients=2) as source:
            batch = source.batch(6)
        assert [process.wait(60) for process in processes] == [0, 0]
    assert list(batch["env_id"]) == [1, 2] * 3
    assert list(batch["step"]) == [0, 0, 1, 1, 2, 2]


def test_manual_clients_require_token(clients, monkeypatch):
    monkeypatch.delenv("PHYSX_TOKEN", raising=False)
    with pytest.raises(ConfigError, match="PHYSX_TOKEN"), clients(launcher="physx/manual"):
        pass


def test_client_without_free_slot_is_refused(by_hand, port):
    errors = []

    def join():
        for wanted in (None, 1, 2):
            with pytest.raises(ConnectionRefusedByPeerError) as caught:
                run_client(f"127.0.0.1:{port}", "a token for this test", wanted)
            errors.append(str(caught.value))

    with hands(1, port), by_hand() as source:
        thread = threading.Thread(target=join)
        thread.start()
        while thread.is_alive():
            source.batch(1)
            time.sleep(0.011)
    assert ["no place for " in error for error in errors] == [True] * 3


SERVER = """
import sys, time
from pathlib import Path
from physx_core.config import EnvironmentConfig
from physx_core.sources.client_source import ClientSource

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
    Path("server.py").write_text(SERVER.format(environment=f"{ENVS}:{name}", kwargs=kwargs))
    server = subprocess.Popen(
        [sys.executable, "server.py"], stderr=subprocess.PIPE, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while not Path("ready").exists():
        assert server.poll() is None, server.stderr.read().decode()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return server


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


def test_ctrl_c_ends_server_and_clients(process_ids):
    server = start_server("Walk", delay=0.01)
    clients = process_ids(server.pid).values()
    assert len(clients) == 2
    os.killpg(server.pid, signal.SIGINT)
    error = server.communicate(timeout=60)[1].decode()
    assert error.strip().endswith("KeyboardInterrupt")
    assert gone_after(clients, 0.1)


@pytest.mark.parametrize("name", ["Walk", "Trouble"])
def test_clients_exit_when_server_is_killed(name, process_ids):
    # Trouble: within a step that takes a minute
    kwargs = {"what": "sleep", "at": 2} if name == "Trouble" else {}
    server = start_server(name, **kwargs)
    clients = process_ids(server.pid).values()
    assert len(clients) == 2
    server.kill()
    server.communicate()
    assert gone_after(clients, 20.0)
