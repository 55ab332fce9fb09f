"""What starts clients: the launchers of the core, and those of others."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from physx_core import ClientHandle, Environment, Launcher, plugins
from physx_core.errors import (
    ClientError,
    ComponentNotFoundError,
    ReferenceFormError,
    UnknownOptionError,
)
from physx_core.workers.launchers import (
    ClientProcess,
    ManualLauncher,
    SubprocessLauncher,
    stop,
)

pytestmark = pytest.mark.processes

HERE = Path(__file__)


# A launcher like that of a plugin ---------------------------------------------------------------


class CommandHandle(ClientHandle):
    def __init__(self, instance_id, process):
        self.instance_id, self.process = instance_id, process

    def exit_status(self):
        return self.process.poll()

    def terminate(self):
        os.killpg(self.process.pid, signal.SIGTERM)

    def kill(self):
        os.killpg(self.process.pid, signal.SIGKILL)


class CommandLauncher(Launcher):
    """Starts ``physx client``, with the token in a file, and notes what it was asked for."""

    def __init__(self, *, notes):
        self.notes = Path(notes)

    def launch(self, instances, address, token):
        file = self.notes / "token"
        file.touch(mode=0o600)
        file.write_text(token)
        (self.notes / f"{time.monotonic_ns()}.launch").write_text(f"{list(instances)}")
        return [CommandHandle(number, self.start(number, address, file)) for number in instances]

    def start(self, number, address, file):
        words = ["--connect", address, "--instance", str(number), "--token-file", str(file)]
        return subprocess.Popen(
            [sys.executable, "-m", "physx_core", "client", *words],
            stdout=(self.notes / f"{number}.out").open("a"),
            start_new_session=True,
        )


class FarLauncher(CommandLauncher):
    """Starts clients that reach this machine at another address than the loopback one."""

    elsewhere = True

    def open(self):
        return "127.0.0.2"

    def launch(self, instances, address, token):
        (self.notes / "address").write_text(address)
        return super().launch(instances, address, token)

    def close(self):
        ended = [(self.notes / f"{number}.out").read_text() for number in (1, 2)]
        (self.notes / "closed").write_text("".join(text.splitlines()[-1] for text in ended))


class IdleHandle(ClientHandle):
    """A client that waits for something forever."""

    def __init__(self, instance_id, queued_until):
        self.instance_id, self.queued_until, self.over = instance_id, queued_until, False

    def exit_status(self):
        return 1 if self.over else None

    def terminate(self):
        self.over = True

    def kill(self):
        self.over = True

    def state(self):
        return "pending (Resources)"

    def is_queued(self):
        return time.monotonic() < self.queued_until


class IdleLauncher(Launcher):
    """Starts clients that wait for their turn, and then never come."""

    def __init__(self, *, queued=0.0):
        self.queued = queued

    def launch(self, instances, address, token):
        return [IdleHandle(number, time.monotonic() + self.queued) for number in instances]


class ForgetfulLauncher(Launcher):
    """Returns no handles, but does not say that people start the clients."""

    def launch(self, instances, address, token):
        return []


class ForeignLauncher(Launcher):
    """Returns what is no handle, or fails."""

    def __init__(self, returns=None):
        self.returns = returns

    def launch(self, instances, address, token):
        return {"none": None, "numbers": [4 for _ in instances]}[self.returns]


class NoLauncher:
    """A class of another kind."""


class Bound(Environment):
    """Tells the processor cores that it may use."""

    def create(self):
        self.save_parameters(cores=sorted(os.sched_getaffinity(0)))

    def init_database(self):
        self.define_training_fields(("x", float))

    def step(self):
        self.set_training_data(x=0.0)


@pytest.fixture
def notes(tmp_path):
    folder = tmp_path / "notes"
    folder.mkdir()
    return folder


@pytest.mark.parametrize("reference", [CommandLauncher, f"{HERE}:CommandLauncher"])
def test_custom_launcher_starts_clients(clients, notes, reference):
    settings = {"launcher": reference, "launcher_kwargs": {"notes": str(notes)}}
    with clients(num_clients=2, **settings) as source:
        assert source.batch(4)["env_id"].tolist() == [1, 2, 1, 2]
    assert [file.read_text() for file in notes.glob("*.launch")] == ["[1, 2]"]
    said = (notes / "2.out").read_text()
    assert "worker_envs.py:Plain, instance 2 of 2" in said
    assert said.endswith("the run has ended\n")


def test_custom_launcher_restarts_client(clients, notes):
    settings = {"launcher": CommandLauncher, "launcher_kwargs": {"notes": str(notes)}}
    kwargs = {"fault": "fail", "at": 3}
    wanderer = f"{HERE.parents[1] / 'programs' / 'restart_envs.py'}:Wanderer"
    with clients(wanderer, num_clients=2, retries=1, env_kwargs=kwargs, **settings) as source:
        assert source.batch(20)["step"].tolist() == [step // 2 for step in range(20)]
    launches = [file.read_text() for file in sorted(notes.glob("*.launch"))]
    assert launches == ["[1, 2]", "[2]"]


@pytest.mark.parametrize("ip_address", ["127.0.0.1", "127.0.0.2", "0.0.0.0"])
def test_server_listens_on_address_reachable_by_remote_clients(clients, notes, ip_address):
    settings = {"launcher": FarLauncher, "launcher_kwargs": {"notes": str(notes)}}
    with clients(num_clients=2, ip_address=ip_address, **settings) as source:
        assert source.batch(2)["env_id"].tolist() == [1, 2]
        assert (notes / "address").read_text().startswith("127.0.0.2:")
        assert not (notes / "closed").exists()
    assert (notes / "closed").read_text().count("the run has ended") == 2


def test_run_reports_what_a_queued_client_waits_for(clients):
    error = r"(?s)did not connect for 0\.5 s while the server waited for it: pending \(Resources\)"
    with pytest.raises(ClientError, match=error), clients(launcher=IdleLauncher, timeout=0.5):
        pass


@pytest.mark.slow
def test_timeout_of_queued_client_starts_when_it_runs(clients, caplog):
    settings = {"launcher": IdleLauncher, "launcher_kwargs": {"queued": 6.0}, "timeout": 0.5}
    began = time.monotonic()
    with pytest.raises(ClientError, match="did not connect"), clients(**settings):
        pass
    assert time.monotonic() - began > 6.2  # asked for every 0.1 s
    assert "pending (Resources)" in caplog.text
    assert "once it has left the queue" in caplog.text


def test_launcher_without_handles_is_an_error(clients):
    with (
        pytest.raises(ClientError, match=r"ForgetfulLauncher\.launch\(\) returned no handle"),
        clients(launcher=ForgetfulLauncher),
    ):
        pass


@pytest.mark.parametrize(
    ("returns", "said"),
    [
        ("none", r"Foreign.*launch\(\) returned None, and not a list of handles.*ClientHandle"),
        ("numbers", r"Client 1 cannot be watched: ForeignLauncher.launch\(\) returned 4, and not"),
        ("words", r"Client 1 was not started: ForeignLauncher.launch\(\) raised KeyError: 'words'"),
    ],
)
def test_what_a_launcher_returns_instead_of_handles_is_named(clients, returns, said):
    settings = {"launcher": ForeignLauncher, "launcher_kwargs": {"returns": returns}}
    with pytest.raises(ClientError, match=said), clients(**settings):
        pass


@pytest.mark.parametrize(
    ("settings", "error", "text"),
    [
        ({"launcher": NoLauncher}, ReferenceFormError, "not derived from Launcher"),
        ({"launcher_kwargs": {"speed": 3}}, UnknownOptionError, 'has no option "speed"'),
        ({"launcher": "physx/manuel"}, ComponentNotFoundError, 'Did you mean "manual"'),
    ],
)
def test_invalid_launcher_is_an_error(clients, settings, error, text):
    with pytest.raises(error, match=text), clients(**settings):
        pass


def test_core_launchers_are_registered_by_hook():
    assert plugins.resolve("launcher", "physx/subprocess") is SubprocessLauncher
    assert plugins.resolve("launcher", "physx/manual") is ManualLauncher
    assert "launcher" in plugins.kind_names()
    assert plugins.available()["physx"].module == "physx_core.plugins.builtin"


# Processes --------------------------------------------------------------------------------------


def test_affinity_pins_clients_to_cores_in_turn(clients, services):
    cores = sorted(os.sched_getaffinity(0))
    settings = {"num_clients": 3, "launcher_kwargs": {"affinity": True}}
    with clients(f"{HERE}:Bound", **settings) as source:
        source.batch(3)
        bound = [services.kept[number]["cores"] for number in (1, 2, 3)]
    assert bound == [[cores[number % len(cores)]] for number in range(3)]
    assert sorted(os.sched_getaffinity(0)) == cores


def test_failed_start_leaves_no_process(clients, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nonexistent/python")
    with pytest.raises(ClientError, match="Client 1 could not be started"), clients(num_clients=2):
        pass


def test_token_has_owner_only_permissions():
    token = "a token that nobody sees"
    process = ClientProcess(1, "127.0.0.1:1", token)
    process.start()
    try:
        entry = Path(f"/proc/{process.pid}")
        command, mode = (entry / "cmdline").read_bytes(), (entry / "environ").stat().st_mode
        status = (entry / "status").read_text()
    finally:
        stop([process], 0.0)
    assert token.encode() not in command
    assert token not in status
    assert not mode & 0o077
