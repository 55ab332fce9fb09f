"""Our client of godot-gym steps a real Godot application, without a window."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

from physx_core import Field
from physx_remote import connect, connect_vector
from physx_remote.errors import RemoteClosedError, RemoteTimeoutError
from physx_remote.godot_gym.messages import Messages

pytestmark = pytest.mark.processes

PROJECT = Path(__file__).parents[1] / "programs" / "godot"
BINARY = "godot3-server"
FRAME = 1 / 60  # s


@pytest.fixture
def binary():
    found = shutil.which(BINARY)
    if found is None and os.environ.get("CI"):
        pytest.fail(f"{BINARY} must be there: .ci/run installs Debian's package of that name")
    if found is None:
        pytest.skip(f"{BINARY} is not installed: it is Debian's package of that name")
    return found


@pytest.fixture
def start(binary, tmp_path):
    """Start the application with words; it is ended with the test."""
    started = []

    def run(*words):
        # Started directly: a wrapper that is killed would leave the engine running.
        process = subprocess.Popen(
            [binary, "--path", str(PROJECT), *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path)},
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@pytest.fixture
def application(start):
    """Return the process that speaks godot-gym, and its address."""
    for _ in range(5):  # another program may take the port first: then it ends at once
        port = free_port()
        process = start(f"--port={port}")
        if b"listening\n" in iter(process.stdout.readline, b""):
            return process, f"127.0.0.1:{port}"
    pytest.fail("the application does not listen")


def connected(address, **options):
    messages = Messages.of_fields(
        agent=[
            Field("position", (3,), "float32"),
            Field("velocity", (3,), "float32"),
            ("name", str),
        ],
        world=[Field("steps", (), "int64"), Field("done", (), "bool")],
    )
    options = {"time_speed": 100.0, "repeat_action": 1, **options}
    force = spaces.Box(-10, 10, (2,), np.float32)
    return connect(address, "godot-gym", messages=messages, action_space=force, **options)


def trajectory(env, forces):
    """Return the ball's positions and velocities under forces, shape (steps, 6)."""
    first, _ = env.reset()
    assert not first["position"].any()
    assert not first["velocity"].any()
    seen = [env.step(np.array(force, np.float32))[0] for force in forces]
    return np.array([[*one["position"], *one["velocity"]] for one in seen])


def test_a_real_godot_steps_its_physics(application):
    env = connected(application[1], repeat_action=3)
    forces = np.random.default_rng(2).uniform(-10, 10, (20, 2))
    seen = trajectory(env, forces)
    position, velocity, expected = np.zeros(3), np.zeros(3), []
    for force in forces:
        for _ in range(3):
            velocity[:2] += force * FRAME
            position += velocity * FRAME
        expected.append([*position, *velocity])
    assert np.allclose(seen, expected, atol=1e-5)
    observation, _, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert env.observation_space.contains(observation)
    assert info["steps"] == 63
    assert terminated == bool(np.linalg.norm(observation["position"]) > 1)
    assert not truncated
    env.close()


def test_the_same_actions_make_the_same_trajectory_at_any_speed(application):
    forces = np.random.default_rng(3).uniform(-1, 1, (8, 2))
    seen = []
    for speed in (100.0, 100.0, 20.0, 4.0):
        env = connected(application[1], time_speed=speed)
        seen.append(trajectory(env, forces))
        env.close()
    assert np.array_equal(seen[0], seen[1])
    assert np.allclose(seen, seen[0], atol=1e-6), "a step is 1/60 s up to rounding"


def test_nothing_moves_between_requests_and_the_next_client_finds_the_state(application):
    env = connected(application[1])
    trajectory(env, [[5, 5]] * 3)
    ask = {"observation": {"agent": [], "world": []}}
    before = env.client.request(ask)
    np.testing.assert_equal(env.client.request(ask), before)
    env.close()
    env = connected(application[1])
    np.testing.assert_equal(env.client.request(ask), before)
    assert before["world"]["steps"] == 3
    env.close()


def test_configuration_reaches_the_application(application):
    env = connected(application[1], repeat_action=0)
    env.client.configure({"agent": {"name": "größer ∞"}})
    env.reset()
    _, _, _, _, info = env.step(np.ones(2, np.float32))
    assert info.get("steps", 0) == 0, "no physics steps for repeat_action 0"
    parts = env.client.request({"observation": {"agent": ["name"]}})
    assert parts["agent"]["name"] == "größer ∞"
    assert parts["world"] is None
    env.client.set_repeat_action(10)
    assert env.step(np.ones(2, np.float32))[4]["steps"] == 10
    env.close()


def test_hang_or_crash_of_godot_application(application):
    process, address = application
    env = connected(address)
    env.reset()
    process.send_signal(signal.SIGSTOP)
    with pytest.raises(RemoteTimeoutError, match="did not answer"):
        connected(address, timeout=0.2)
    process.send_signal(signal.SIGCONT)
    assert env.step(np.zeros(2, np.float32))[4]["steps"] == 1
    process.kill()
    with pytest.raises(RemoteClosedError):
        for _ in range(3):
            env.step(np.zeros(2, np.float32))
    env.close()


def test_agents_of_a_godot_application_that_comes_to_its_trainer(start):
    port = free_port()
    process = start("res://rl.tscn", f"--port={port}", "--action_repeat=3")
    vector = connect_vector(f"127.0.0.1:{port}", "godot-rl")
    assert (vector.num_envs, vector.agent_policy_names) == (2, ["a", "b"])
    assert vector.single_action_space == spaces.Dict({"force": spaces.Box(-1, 1, (2,), np.float32)})
    assert vector.reset(seed=1)[0].tolist() == [[0.0] * 6] * 2
    direction = np.array([[1.0, 0.0], [0.0, -0.5]])
    force, velocity, distance = 10 * np.array([1.0, 0.5]), np.zeros(2), np.zeros(2)
    while distance[0] <= 1:
        seen, rewards, terminated, truncated, _ = vector.step({"force": direction})
        for _ in range(3):
            velocity += force * FRAME
            distance += velocity * FRAME
        assert np.allclose(-rewards, distance, atol=1e-4)
        assert terminated.tolist() == [bool(distance[0] > 1), False]
        assert not truncated.any()
        place = np.where(terminated, 0, distance)
        assert np.allclose(seen[:, :2], place[:, np.newaxis] * np.sign(direction), atol=1e-4)
    assert vector.call("mass") == (1.0, 1.0)
    vector.close()
    assert process.wait(60) == 0
