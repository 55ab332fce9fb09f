"""Unmodified godot-rl as the trainer of our environments; launch flags and launcher files."""

from __future__ import annotations

import json
import random
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from physx_core.errors import ConfigError, UsageError
from physx_remote.godot_rl.launch import (
    main,
    parse_flags,
    write_launcher,
)
from physx_remote.godot_rl.protocol import GodotRL
from physx_remote.serving.worlds import open_worlds

pytestmark = pytest.mark.processes

HERE = Path(__file__).parent
CART = f"{HERE / 'envs.py'}:Cart"
MODULE = "physx_remote.godot_rl.launch"


@pytest.fixture
def port():
    """Two ports in a row that are free, below those that the system gives away by itself."""
    while True:
        port = random.SystemRandom().randrange(12_000, 30_000)
        try:
            with (
                socket.create_server(("127.0.0.1", port)),
                socket.create_server(("127.0.0.1", port + 1)),
            ):
                return port
        except OSError:
            continue


@pytest.fixture
def train(port):
    """Run a scenario of the trainer; where it gets no launcher, the worlds are served from here."""
    trainers = []

    def run(scenario, launcher=None, worlds=None, fails="", **options):
        words = [scenario, str(port), *([str(launcher)] if launcher else [])]
        trainers.append(
            subprocess.Popen(
                [sys.executable, str(HERE / "trainer.py"), *words],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
        )
        if worlds is not None:
            with worlds, GodotRL(**options).service(worlds, port=port) as service:
                service.run()
        out, errors = trainers[-1].communicate(timeout=120)
        if fails:
            assert fails in errors
            return trainers[-1].returncode
        assert trainers[-1].returncode == 0, errors
        return json.loads(out.splitlines()[-1])

    yield run
    for trainer in trainers:
        trainer.kill()
        trainer.wait()


def expected(seed):
    """Return what one CartPole sees in the trainer's scenario, and where its episodes end."""
    env = gymnasium.make("CartPole-v1")
    seen, ends = [env.reset(seed=seed)[0].tolist()], []
    for number in range(40):
        observation, _, terminated, truncated, _ = env.step(int(number % 3 != 0))
        ended = terminated or truncated
        ends.append([ended, {"obs": observation.tolist()} if ended else None])
        seen.append((env.reset()[0] if ended else observation).tolist())
    return seen, ends


def test_godot_env_drives_images_and_several_kinds_of_actions(train):
    told = train("godot_env", worlds=open_worlds(CART, 2), seed=5, action_repeat=2)
    assert told["num_envs"] == 2
    assert "Box(0, 255, (2, 3, 3), uint8)" in told["spaces"][0]
    assert "Discrete(3)" in told["spaces"][1]
    dtype, camera = told["camera"]
    assert dtype == "uint8"
    assert camera[0][0] == [255, 1, 16]
    before, after = (np.array(seen) for seen in told["positions"])
    assert np.allclose(after - before, [[5.0, 0.0]] * 2, atol=1e-12), "two steps of 2.5 each"
    assert before[0].tolist() == np.random.default_rng(5).random(2).tolist()
    rewards, done, also_done, infos = told["step"]
    assert (rewards, done, also_done) == ([1.0, 1.0], [False, False], [False, False])
    assert infos == [{"gear": 2, "terminated": False, "truncated": False}] * 2
    assert told["call"] == [{"name": "cart", "steps": 2}] * 2


def test_clean_rl_sees_the_episodes_of_an_environment_in_this_process(train):
    told = train("clean_rl", worlds=open_worlds("gym/CartPole-v1", 3), seed=11)
    assert told["num_envs"] == 3
    seen, ends = expected(11)
    assert [observations[0] for observations in told["seen"]] == seen
    assert [[done[0], last[0]] for done, last in told["ends"]] == ends
    assert any(done for done, _ in ends)
    first = told["seen"][0]
    assert len({tuple(observation) for observation in first}) == 3, "agents differ"


@pytest.mark.faults
def test_stable_baselines_learns_in_environments_that_its_wrapper_starts(train, tmp_path):
    launcher = write_launcher(tmp_path / "cart.x86_64", "gym/CartPole-v1", num_worlds=2)
    told = train("stable_baselines", launcher)
    assert told["num_envs"] == 4
    assert told["updates"] == 20, "ten epochs after each 256 steps"
    lengths, returns = told["ends"]
    assert len(lengths) > 8
    assert lengths == returns, "the reward of each step is 1"


def test_petting_zoo(train):
    told = train("petting_zoo", worlds=open_worlds(CART, 3, {"length": 1}))
    assert told["agents"] == [0, 1, 2]
    assert told["policies"] == ["shared_policy"] * 3
    assert told["levels"] == [0] * 6, "each agent's episode ends at once and the next begins"
    rewards, ended, infos = told["rest"]
    assert (rewards, ended) == ([0.5] * 3, [True] * 3)
    assert all(info["truncated"] and not info["terminated"] for info in infos)


def test_a_launcher_is_started_twice_and_ends_with_its_trainer(train, tmp_path):
    launcher = write_launcher(tmp_path / "cart.x86_64", "gym/CartPole-v1", num_worlds=2)
    told = train("clean_rl", launcher)
    assert told["num_envs"] == 4
    assert told["statuses"] == [0, 0]
    for place, seed in ((0, 11), (2, 12)):  # godot-rl gives each process a seed of its own
        seen, ends = expected(seed)
        assert [observations[place] for observations in told["seen"]] == seen
        assert [[done[place], last[place]] for done, last in told["ends"]] == ends


def test_an_error_of_the_environment_ends_the_trainer(train, caplog):
    """Godot-rl knows no errors, and would wait for ever for a side that is gone."""
    worlds = open_worlds(CART, 1, {"fails_at": 1})
    assert train("godot_env", worlds=worlds, fails="KeyError: 'obs'") == 1
    assert "the cart fell over" in caplog.text


# Flags --------------------------------------------------------------------------------------------


def test_flags_as_godot_rl_writes_them():
    words = (
        "--port=11010 --env_seed=3 --disable-render-loop --headless --fixed-fps 60 "
        "--action_repeat=8 --speedup=4 --length=20 --name=my_cart --fast=True --none=None"
    )
    assert parse_flags(words.split(" ")) == {
        "port": 11010,
        "seed": 3,
        "action_repeat": 8,
        "env_kwargs": {"length": 20, "name": "my_cart", "fast": True, "none": None},
    }


def test_flags_may_be_left_out_and_the_last_one_counts():
    assert parse_flags([]) == {"env_kwargs": {}}
    words = ["--num_worlds=4", "--num_worlds=2", "--timeout=2.5", "--show"]
    assert parse_flags(words) == {"num_worlds": 2, "timeout": 2.5, "env_kwargs": {"show": True}}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["11008"], '"11008" is not a flag'),
        (["-p"], '"-p" is not a flag'),
        (["--port=x"], '--port takes a number, not "x"'),
        (["--env_seed"], "--env_seed takes a number"),
        (["--fixed-fps"], "--fixed-fps takes a number"),
    ],
)
def test_invalid_flags(words, said):
    with pytest.raises(UsageError, match=said):
        parse_flags(words)


# Launcher files and the command -------------------------------------------------------------------


def test_a_launcher_finds_a_script_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(HERE)
    path = write_launcher(
        tmp_path / "cart.x86_64",
        "envs.py:Cart",
        num_worlds=3,
        action_repeat=2,
        env_kwargs={"name": "it's $HOME"},
    )
    assert path.stat().st_mode & 0o111
    script = path.read_text()
    assert CART in script
    assert script.endswith(' "$@"\n')
    echo = path.with_name("echo.x86_64")  # the shell must hand on every word unchanged
    echo.write_text(script.replace(sys.executable, "echo"))
    said = subprocess.run(["/bin/sh", echo, "--port=7"], capture_output=True, text=True, check=True)
    words = f"-m {MODULE} {CART} --num_worlds=3 --action_repeat=2 --name=it's $HOME --port=7\n"
    assert said.stdout == words


@pytest.mark.parametrize("name", ["cart", "cart.sh", "my cart.x86_64"])
def test_godot_rl_could_not_start_other_names(tmp_path, name):
    with pytest.raises(ConfigError, match="x86_64"):
        write_launcher(tmp_path / name, "gym/CartPole-v1")


def test_the_command_says_why_it_ends(port, capsys):
    assert main(["gym/CartPole-v1", f"--port={port}", "--timeout=0.1"]) == 1
    assert f"port {port}" in capsys.readouterr().err
    assert main(["gym/CartPol-v1"]) == 1
    assert 'Did you mean "CartPole-v1"?' in capsys.readouterr().err
    assert main(["gym/CartPole-v1", "--lenght=3"]) == 1
    assert "lenght" in capsys.readouterr().err
    assert main([]) == main(["--help"]) == 0
    assert "--env_seed" in capsys.readouterr().out


@pytest.mark.parametrize("is_told", [False, True])
def test_process_exits_with_trainer_or_on_signal(is_told):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        words = ["gym/CartPole-v1", f"--port={listener.getsockname()[1]}"]
        process = subprocess.Popen([sys.executable, "-m", MODULE, *words])
        trainer, _ = listener.accept()
    with trainer:
        ask(trainer)
        if is_told:
            process.terminate()
            assert process.wait(60) == 128 + signal.SIGTERM
            return
    assert process.wait(60) == 0


def ask(trainer):
    """Ask for the spaces, after which the process surely waits for the next message."""
    message = b'{"type": "env_info"}'
    trainer.sendall(len(message).to_bytes(4, "little") + message)
    assert trainer.recv(4, socket.MSG_WAITALL)


def test_the_command_is_installed():
    command = shutil.which("physx-godot-rl", path=str(Path(sys.executable).parent))
    assert command is not None, "install physx_core again: it has this command"
    done = subprocess.run([command, "--help"], capture_output=True, text=True, check=True)
    assert "usage: physx-godot-rl ENVIRONMENT" in done.stdout
