"""The trainer's side of godot-rl: over our own service, and over odd and faulty applications."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from physx_core.errors import UsageError
from physx_core.plugins import find
from physx_remote import connect, connect_vector, open_worlds, serve
from physx_remote.errors import (
    RemoteClosedError,
    RemoteError,
    RemoteProtocolError,
    RemoteTimeoutError,
)
from physx_remote.godot_rl.protocol import GodotRL

CART = f"{Path(__file__).with_name('envs.py')}:Cart"


@pytest.fixture
def beside():
    """Run a function in a thread, and wait for it at the end."""
    threads = []

    def run(function, *arguments):
        threads.append(threading.Thread(target=function, args=arguments, daemon=True))
        threads[-1].start()

    yield run
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()


@pytest.fixture
def served(beside, port):
    """Serve worlds from a thread to a trainer here."""

    def run(environment, num_worlds=1, env_kwargs=None, **options):
        def work():
            with serve(
                environment, "godot-rl", port=port, num_worlds=num_worlds, env_kwargs=env_kwargs,
                timeout=30.0, **options,
            ) as service:  # fmt: skip
                service.run()

        beside(work)
        return f"127.0.0.1:{port}"

    return run


def test_agents_are_a_vector_environment(served):
    address = served("gym/CartPole-v1", 3)
    vector = connect_vector(address, "godot-rl")
    assert vector.single_action_space == spaces.Discrete(2)
    assert vector.single_observation_space.shape == (4,)
    assert vector.agent_policy_names == ["shared_policy"] * 3
    alone = gymnasium.make("CartPole-v1")
    seen, _ = vector.reset(seed=6)
    assert np.array_equal(seen[0], alone.reset(seed=6)[0])
    ended = False
    for number in range(30):
        actions = np.full(3, number % 3 != 0)
        seen, rewards, terminated, truncated, infos = vector.step(actions)
        expected, _, ended, _, _ = alone.step(int(actions[0]))
        assert rewards.tolist() == [1.0] * 3
        assert bool(terminated[0]) == ended
        assert not truncated.any()
        if ended:
            assert np.array_equal(infos["final_obs"][0], expected)
            expected, _ = alone.reset()
        assert np.array_equal(seen[0], expected)
    vector.close()


def test_one_agent_is_an_environment_with_every_kind_of_space(served):
    env = connect(served(CART, 1, {"length": 3}), "godot-rl")
    cart = find("environment", CART)(length=3)
    for seed in (4, 5):
        first, info = env.reset(seed=seed)
        assert env.observation_space.contains(first)
        assert np.array_equal(first["position"], cart.reset(seed=seed)[0]["position"])
        assert info["array"] == [0, 1]
        for number in range(3):
            action = {"force": np.array([1.0, -1.0], np.float32), "gear": np.int64(2)}
            seen, reward, terminated, truncated, info = env.step(action)
            expected, *_ = cart.step({"force": np.array([4.0, 0.0]), "gear": 2})
            assert np.array_equal(seen["position"], expected["position"])
            assert np.array_equal(seen["camera_2d"], expected["camera"])
            assert seen["level"] == expected["level"] - 1
            assert (reward, terminated, truncated) == (0.5, False, number == 2)
            assert info["gear"] == 2
    assert env.agents.call("who") == ({"name": "cart", "steps": 0},)
    env.close()


def test_one_environment_needs_one_agent(served):
    with pytest.raises(RemoteError, match="connect_vector"):
        connect(served(CART, 2), "godot-rl")


def test_errors_of_the_application_are_raised_here(served):
    env = connect(served(CART, 1, {"fails_at": 1}), "godot-rl")
    env.reset()
    with pytest.raises(RemoteError, match="ArithmeticError: the cart fell over"):
        env.step(env.action_space.sample())
    with pytest.raises(RemoteError, match='Did you mean "who"'):
        env.agents.call("whom")
    with pytest.raises(UsageError, match="options"):
        env.reset(options={"a": 1})
    env.reset()
    env.close()
    with pytest.raises(RemoteClosedError, match="closed here"):
        env.reset()


def test_nobody_comes(port):
    with pytest.raises(RemoteTimeoutError, match=rf"{port} within 0.1 s"):
        connect(f"127.0.0.1:{port}", "godot-rl", connect_timeout=0.1)


def test_the_port_is_taken(port):
    with (
        socket.create_server(("127.0.0.1", port)),
        pytest.raises(RemoteError, match="may be using the port"),
    ):
        connect(f"127.0.0.1:{port}", "godot-rl", connect_timeout=0.1)


ENTRY = {"obs": {"size": [1], "space": "box"}}
MOVE = {"move": {"size": 3, "action_type": "discrete"}}
INFO = {
    "type": "env_info",
    "n_agents": 2,
    "observation_space": ENTRY,
    "action_space": MOVE,
}
STEP = {"type": "step", "obs": [{"obs": [1]}] * 2, "reward": [1, 2], "done": [True, False]}


def application(port, *answers):
    """Answer a trainer with what is given, and leave."""
    deadline = time.monotonic() + 60
    while True:
        try:
            trainer = socket.create_connection(("127.0.0.1", port))
            break
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.01)
    with trainer:
        reader = trainer.makefile("rb")
        reader.read(struct.unpack("<I", reader.read(4))[0])  # the handshake
        for answer in answers:
            reader.read(struct.unpack("<I", reader.read(4))[0])
            body = answer if isinstance(answer, bytes) else json.dumps(answer).encode()
            trainer.sendall(struct.pack("<I", len(body)) + body)


def test_an_application_of_an_older_version(port, beside):
    beside(application, port, INFO, {"type": "reset", "obs": [{"obs": [0]}] * 2}, STEP)
    with connect_vector(f"127.0.0.1:{port}", "godot-rl") as vector:
        assert vector.single_action_space == spaces.Dict({"move": spaces.Discrete(3)})
        assert vector.reset()[0].tolist() == [[0], [0]]
        seen, rewards, terminated, truncated, _ = vector.step({"move": np.array([2, 0])})
        assert seen.tolist() == [[1], [1]]
        assert rewards.tolist() == [1, 2]
        assert (terminated.tolist(), truncated.tolist()) == ([True, False], [False, False])
        with pytest.raises(RemoteClosedError):
            vector.reset()
    assert vector.closed


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"{",
        b"[]",
        b"\xff",
        {"type": "step"},
        {**INFO, "n_agents": 0},
        {**INFO, "n_agents": "2"},
        {**INFO, "observation_space": 3},
        {**INFO, "observation_space": {"obs": {"size": [-1], "space": "box"}}},
        {**INFO, "observation_space": {"obs": {"size": [1], "space": "ball"}}},
        {**INFO, "action_space": {"move": {"size": 0, "action_type": "discrete"}}},
        {**INFO, "action_space": {"move": {"size": 1, "action_type": "magic"}}},
        {**INFO, "action_space": [MOVE]},
    ],
)
def test_invalid_descriptions(port, beside, answer):
    beside(application, port, answer)
    with pytest.raises(RemoteError):
        connect_vector(f"127.0.0.1:{port}", "godot-rl")


@pytest.mark.parametrize(
    "change",
    [
        {"obs": [{"obs": [1]}]},
        {"obs": [{"obs": [1, 2]}, {"obs": [1]}]},
        {"obs": [{"obs": "x"}, {"obs": [1]}]},
        {"obs": [{}, {}]},
        {"obs": None},
        {"reward": ["x", 1]},
        {"reward": [1]},
        {"done": 3},
        {"info": [1, 2]},
        {"type": "reset"},
    ],
)
def test_invalid_answers(port, beside, change):
    beside(application, port, INFO, {**STEP, **change})
    vector = connect_vector(f"127.0.0.1:{port}", "godot-rl")
    with pytest.raises(RemoteProtocolError):
        vector.step({"move": np.array([2, 0])})
    vector.close()


def test_agents_that_differ(port, beside):
    beside(application, port, {**INFO, "action_space": [MOVE, {}]})
    with pytest.raises(RemoteError, match="do not all have the same action_space"):
        connect_vector(f"127.0.0.1:{port}", "godot-rl")


def test_the_service_of_an_address_in_words(beside, port):
    """The name of this machine works as well as its number."""
    beside(lambda: GodotRL().service(open_worlds(CART), address="localhost", port=port).run())
    env = connect(f"127.0.0.1:{port}", "godot-rl")
    env.reset()
    env.close()
