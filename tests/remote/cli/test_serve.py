"""The command `physx serve`, in processes of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from physx_core.cli import main
from physx_remote import connect, connect_vector

pytestmark = pytest.mark.processes

PATIENCE = 30.0
GODOT = ["--protocol", "godot-gym"]


@pytest.fixture
def start(monkeypatch):
    """Start the command; return the process, what it printed at first, and its address."""
    monkeypatch.delenv("PHYSX_TOKEN", raising=False)
    with contextlib.ExitStack() as stack:

        def start(*words, lines=2, **variables):
            process = subprocess.Popen(
                [sys.executable, "-m", "physx_core.cli", "serve", *words, "--port", "0"],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONFAULTHANDLER": "1", **variables},
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            watchdog = threading.Timer(2 * PATIENCE, process.send_signal, [signal.SIGABRT])
            watchdog.start()
            stack.callback(watchdog.cancel)
            printed = [process.stdout.readline() for _ in range(lines)]
            if "listening at" not in printed[0]:
                process.kill()
                pytest.fail(process.stderr.read())
            return process, printed, printed[0].split()[-1]

        yield start


def end(process, number=signal.SIGINT):
    process.send_signal(number)
    out, error = process.stdout.read(), process.stderr.read()
    status = process.wait(PATIENCE)
    assert status != -signal.SIGABRT, error  # it hung; the error says where
    return status, out, error


def test_a_generated_token_is_removed(start):
    process, printed, address = start("gym/CartPole-v1", "--num-worlds", "2")
    file = Path(printed[1].removeprefix("token: ").strip())
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    token = file.read_text().strip()
    with contextlib.closing(connect_vector(address, token_file=str(file))) as env:
        env.reset(seed=0)
        assert env.num_envs == 2
    status, out, error = end(process)
    assert status == 130 and "interrupted" in error
    assert token not in out + error and "Ctrl-C" in out
    assert not file.exists()


def test_a_generated_token_is_removed_after_a_kill(start, tmp_path):
    process, printed, _ = start("gym/CartPole-v1", TMPDIR=str(tmp_path))
    assert tmp_path in Path(printed[1].removeprefix("token: ").strip()).parents
    end(process, signal.SIGKILL)
    deadline = time.monotonic() + PATIENCE
    while [*tmp_path.iterdir()]:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_token_file_is_created_and_kept(start, tmp_path):
    file = tmp_path / "token"
    words = ("physx/Cartpole-v0", "--token-file", str(file), "--env-kwargs", "continuous=true")
    process, printed, address = start(*words)
    assert str(file) in printed[1] and stat.S_IMODE(file.stat().st_mode) == 0o600
    before = file.read_text()
    with connect(address, token_file=str(file)) as env:
        env.reset(seed=0)
        env.step([0.5])
    assert end(process)[0] == 130
    process, _, address = start(*words)
    with connect(address, token_file=str(file)) as env:
        env.reset()
    status, _, error = end(process, signal.SIGTERM)
    assert status == 143 and error.endswith("physx: terminated\n")
    assert "SystemExit" not in error
    assert file.read_text() == before


def test_a_token_from_the_environment_and_a_physx_environment(start, monkeypatch):
    token = "a-token-of-enough-characters"
    process, printed, address = start("toy/spring", "--env-kwargs", "mass=2", PHYSX_TOKEN=token)
    assert "PHYSX_TOKEN" in printed[1]
    monkeypatch.setenv("PHYSX_TOKEN", token)
    with connect(address) as env:
        assert set(env.reset(seed=1)[0]) == {"state", "force", "next_state"}
    assert end(process)[0] == 130


def test_over_godot_gym(start):
    words = ("--protocol", "godot-gym", "--options", "clients=serve")
    process, _, address = start("gym/CartPole-v1", *words, lines=1)
    with connect(address, "godot-gym") as one, connect(address, "godot-gym") as other:
        assert (one.reset(seed=1)[0] == other.reset(seed=1)[0]).all()
    status, _, error = end(process)
    assert status == 130 and "Traceback" not in error


def test_a_launcher_for_trainers(capsys, tmp_path):
    file = tmp_path / "pole.x86_64"
    words = ["serve", "gym/CartPole-v1", "--num-worlds", "2", "--write-launcher", str(file)]
    assert main(words) == 1
    assert "--protocol godot-rl" in capsys.readouterr().err
    assert main([*words, "--protocol", "godot-rl", "--options", "action_repeat=3"]) == 0
    assert str(file) in capsys.readouterr().out
    text = file.read_text()
    assert "--num_worlds=2" in text and "--action_repeat=3" in text
    assert os.access(file, os.X_OK)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["physx/Cartpol-v0"], "Cartpole"),
        (["toy/sprin"], 'Did you mean "spring"'),
        (["gym/CartPole-v1", "--protocol", "physics"], 'Did you mean "physx"'),
        (["gym/CartPole-v1", "--port", "99999"], "port"),
        (["gym/CartPole-v1", "--address", "203.0.113.1"], "address of this machine"),
        (["gym/CartPole-v1", "--options", "patience=3"], "patience"),
        (["gym/CartPole-v1", "--options", "max_clients=0"], "at least 1"),
        (["gym/CartPole-v1", "--num-worlds", "0"], "at least 1"),
        (["gym/CartPole-v1", "--env-kwargs", "speed=3"], "speed"),
        (["gym/CartPole-v1", "--token-file", "/nowhere/token"], "cannot be written"),
        (["gym/CartPole-v1", *GODOT, "--token-file", "t"], "is for the protocol"),
        (["gym/CartPole-v1", *GODOT, "--num-worlds", "2"], "one world"),
        ([], "ENVIRONMENT"),
    ],
)
def test_errors_say_what_to_do(capsys, monkeypatch, words, message):
    monkeypatch.delenv("PHYSX_TOKEN", raising=False)
    if "--port" not in words:
        words = [*words, "--port", "0"]
    assert main(["serve", *words]) == 1
    printed = capsys.readouterr()
    assert message in printed.err + printed.out
    assert "Traceback" not in printed.err


def test_token_file_with_group_permissions_is_refused(capsys, tmp_path):
    file = tmp_path / "token"
    file.write_text("0123456789abcdef")
    file.chmod(0o644)
    assert main(["serve", "gym/CartPole-v1", "--token-file", str(file)]) == 1
    assert "chmod 600" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["0.0.0.0", "127.0.0.1"])
def test_a_protocol_without_encryption_is_warned_of_beyond_the_loopback_interface(start, address):
    process, _, _ = start("gym/CartPole-v1", *GODOT, "--address", address)
    _, _, error = end(process)
    warned = "neither encrypts nor authenticates" in error
    assert warned == (address == "0.0.0.0"), error
