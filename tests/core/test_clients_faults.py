"""ClientSource: clients that end, are killed, hang, crash, or leave something running."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from physx_core.errors import ClientError


@pytest.mark.parametrize(
    ("what", "method", "text", "status"),
    [
        ("vanish", "step", "Client 2 ended with exit status 3", 3),
        ("leave", "step", "Client 2 ended with exit status 5", 5),
        ("vanish", "create", "Client 2 ended with exit status 3 after 0 rows", 3),
        ("leave", "__init__", "Client 2 ended with exit status 5 after 0 rows", 5),
        ("vanish", "close", "Client 2 ended with exit status 3", 3),
    ],
)
def test_a_client_that_ends_is_named(clients, what, method, text, status):
    kwargs = {"what": what, "method": method, "who": 2}
    with (
        pytest.raises(ClientError, match=text) as caught,
        clients("Trouble", num_clients=3, env_kwargs=kwargs, run_ahead=2) as source,
    ):
        source.batch(3)
        if method != "close":
            source.batch(30)
    assert caught.value.instance_id == 2
    assert caught.value.exit_status == status
    if what == "vanish":
        assert caught.value.stderr == "last words"
        assert "last words" in str(caught.value)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_client_that_is_killed_is_named_within_two_seconds(clients, number):
    with (
        pytest.raises(
            ClientError, match=rf"Client 2 was killed by signal .*{number.name}"
        ) as caught,
        clients("Walk", num_clients=2, env_kwargs={"delay": 0.02}) as source,
    ):
        source.batch(4)
        timer = threading.Timer(0.1, os.kill, (process_ids()[2], number))
        timer.start()
        began = time.monotonic()
        while True:
            source.batch(2)
    assert time.monotonic() - began < 2.1
    assert caught.value.exit_status == -number
    timer.join()


def process_ids():
    """Instance number to process id, from the command lines of this process's clients."""
    found = {}
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = command.read_bytes().split(b"\0")
            parent = (command.parent / "stat").read_text().rpartition(")")[2].split()[1]
        except OSError:
            continue
        if b"--instance" in words and int(parent) == os.getpid():
            found[int(words[words.index(b"--instance") + 1])] = int(command.parent.name)
    return found


@pytest.mark.parametrize("what", ["spin", "stop"])
def test_a_client_that_hangs_is_named_at_the_timeout(clients, what):
    kwargs = {"what": what, "who": 2, "method": "never" if what == "stop" else "step"}
    settings = {"num_clients": 2, "env_kwargs": kwargs, "timeout": 2.5}
    with (
        pytest.raises(ClientError, match=r"Client 2 sent nothing for 2\.5 s") as caught,
        clients("Trouble", run_ahead=0, **settings) as source,
    ):
        source.batch(4)
        if what == "stop":
            os.kill(process_ids()[2], signal.SIGSTOP)
        began = time.monotonic()
        source.batch(8)
    assert caught.value.exit_status is None
    assert 2.4 < time.monotonic() - began < 8


def test_a_client_that_hangs_before_it_is_ready_is_named(clients):
    kwargs = {"what": "sleep", "method": "create"}
    with (
        pytest.raises(ClientError, match="Client 1 sent nothing"),
        clients("Trouble", env_kwargs=kwargs, timeout=2.5),
    ):
        pass


def test_a_client_that_cannot_start_is_noticed_at_once(clients, monkeypatch, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "numpy.py").write_text("raise ImportError('numpy is broken today')\n")
    monkeypatch.setenv("PYTHONPATH", str(broken))
    began = time.monotonic()
    with pytest.raises(ClientError, match="before it connected") as caught, clients("Plain"):
        pass
    assert time.monotonic() - began < 5
    assert caught.value.exit_status == 1
    assert "numpy is broken today" in caught.value.stderr


def test_a_crash_says_where_it_happened(clients):
    with (
        pytest.raises(ClientError, match=r"SIGSEGV") as caught,
        clients("Trouble", env_kwargs={"what": "crash"}) as source,
    ):
        source.batch(9)
    assert "in crash" in caught.value.stderr


def test_what_an_environment_leaves_running_is_ended(clients, tmp_path, monkeypatch):
    note = tmp_path / "child"
    monkeypatch.setenv("PHYSX_TEST_CHILD", str(note))
    with clients("Trouble", env_kwargs={"what": "leave_child", "method": "create"}) as source:
        source.batch(2)
        os.kill(int(note.read_text()), 0)


def test_after_an_error_outside_the_clients_are_not_waited_for(clients):
    began = time.monotonic()
    with (
        pytest.raises(KeyboardInterrupt),
        clients("Trouble", env_kwargs={"what": "sleep", "at": 2}) as source,
    ):
        source.batch(2)
        raise KeyboardInterrupt
    assert time.monotonic() - began < 6
