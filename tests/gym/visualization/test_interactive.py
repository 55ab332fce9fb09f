"""Playing with the keyboard, through a pseudo terminal."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest

from physx_core.errors import UsageError
from physx_gym import Layer, RobotEnv
from physx_gym.visualization.interactive import Keyboard

pty = pytest.importorskip("pty", reason="there are no pseudo terminals")
termios = pytest.importorskip("termios", reason="there are no terminals of this kind")

UP, DOWN, RIGHT, LEFT = (b"\x1b[A", b"\x1b[B", b"\x1b[C", b"\x1b[D")


class Played(RobotEnv):
    """Presses keys by itself: at reset, and after so many calls of `_key_to_action`."""

    script: dict[int, bytes]
    terminal: int

    def _key_to_action(self, key, obs, reward, **kwargs):
        self.calls.append((key, obs, reward, kwargs))
        os.write(self.terminal, self.script.get(len(self.calls), b""))
        if key is None:
            return None
        return np.full(2, {"Right": 1.0, "Left": -1.0}.get(key, 0.0))

    def _initialize_buffers(self):
        os.write(self.terminal, self.script.get(0, b""))

    def has_terminated(self, info):
        return self.num_steps >= 6, False


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture
def terminal(monkeypatch):
    """The end of a terminal at which keys are pressed; the other end is the standard input."""
    keys, screen = pty.openpty()
    with os.fdopen(screen, "r") as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield keys
    os.close(keys)


@pytest.fixture
def env(terminal):
    env = Played("cartpole", 0.002)
    env.calls, env.script, env.terminal = [], {}, terminal
    yield env
    env.close()


def keys_of(env):
    return [call[0] for call in env.calls]


def test_keys_become_actions_until_the_end(env):
    env.script = {0: b"p", 1: RIGHT, 3: LEFT, 4: b"x", 5: b"k"}
    actions = []
    env.compute_command = lambda action, command: actions.append(action[0])
    env.play_interactive(speed=3)
    assert keys_of(env) == [None, "Right", None, "Left", "x"]
    assert actions == [0.0, 1.0, 1.0, -1.0, 0.0]
    assert env.calls[0][2] is None
    assert env.calls[1][2] == 0.0
    assert [float(call[1]["t"]) for call in env.calls] == pytest.approx(
        [0, 0.002, 0.004, 0.006, 0.008]
    )
    assert env.calls[0][3] == {"speed": 3}
    assert not env.is_simulation_running


def test_without_a_pause_it_runs_at_once_until_the_episode_ends(env, capsys):
    env.play_interactive(start_paused=False)
    assert len(env.calls) == 6
    assert capsys.readouterr().out.splitlines() == ["keys: k quits, p pauses", "terminated"]


def test_the_next_episode_begins_on_request(env, capsys):
    env.script = {8: b"k"}
    env.play_interactive(start_paused=False, enable_is_done=False, verbose=False)
    assert [float(call[1]["t"]) for call in env.calls][6:] == pytest.approx([0.0, 0.002])
    assert env.calls[6][2] is None
    assert capsys.readouterr().out == ""


def test_a_pause_stops_time_and_keys(env):
    env.script = {2: b"p" + RIGHT + b"p", 4: b"k"}
    env.play_interactive(start_paused=False)
    assert len(env.calls) == 4
    env.script = {0: RIGHT + b"k"}
    env.calls.clear()
    env.play_interactive(start_paused=True)
    assert env.calls == []


def test_the_terminal_is_restored(env):
    before = termios.tcgetattr(sys.stdin.fileno())
    env.script = {1: b"k"}
    env.play_interactive(start_paused=False)
    assert termios.tcgetattr(sys.stdin.fileno()) == before

    def fail(*_):
        raise RuntimeError("oops")

    env.compute_reward = fail
    with pytest.raises(RuntimeError, match="oops"):
        env.play_interactive(start_paused=False)
    assert termios.tcgetattr(sys.stdin.fileno()) == before


def test_keys_are_assembled_from_bytes(terminal):
    with Keyboard() as keyboard:
        os.write(terminal, UP + DOWN + b"a" + "é€".encode() + b"\x1bOC" + b"\x1b[15~" + b"\x1bz")
        assert keyboard.read() == ["Up", "Down", "a", "é", "€", "Right", "z"]
        os.write(terminal, LEFT[:1])
        assert keyboard.read() == []
        os.write(terminal, LEFT[1:])
        assert keyboard.read() == ["Left"]
        assert keyboard.read() == []


def test_a_layer_on_top_is_played(env):
    class Halved(Layer):
        def compute_reward(self, terminated, info):
            return 7.0

    env.script = {3: b"k"}
    Halved(env).play_interactive(start_paused=False)
    assert [call[2] for call in env.calls] == [None, 7.0, 7.0]


def test_without_a_terminal_or_keys(monkeypatch, terminal):
    with Path(os.devnull).open() as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        with pytest.raises(UsageError, match="needs a terminal"):
            RobotEnv("cartpole", 0.02).play_interactive()
    with os.fdopen(os.dup(terminal)) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with pytest.raises(UsageError, match="RobotEnv cannot be played: override _key_to_action"):
            RobotEnv("cartpole", 0.02).play_interactive(start_paused=False)
