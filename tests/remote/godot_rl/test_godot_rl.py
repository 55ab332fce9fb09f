"""The protocol godot-rl over real sockets, against a trainer made of plain bytes."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from physx_core.errors import ConfigError, UsageError
from physx_remote import Worlds, open_worlds
from physx_remote.godot_rl.protocol import GodotRL

ACTION = {"force": [0.0, -1.0], "gear": 1}


# What the trainer asks ------------------------------------------------------------------------


def test_handshake_is_not_answered(trainer, caplog):
    one = trainer()
    one.send({"type": "handshake", "major_version": "0", "minor_version": "7"})
    assert one.is_silent()
    assert not caplog.records
    one.send({"type": "handshake", "major_version": "1", "minor_version": "0"})
    assert one.is_silent()
    assert "version 1.0" in caplog.text


def test_env_info_describes_each_agent(trainer):
    info = trainer(num=2).ask({"type": "env_info"})
    observation = {
        "camera_2d": {"space": "box", "size": [2, 3, 3], "low": 0, "high": 255},
        "level": {"space": "discrete", "size": 5},
        "position": {"space": "box", "size": [2], "low": -10.0, "high": 10.0},
    }
    action = {
        "force": {"size": 2, "action_type": "continuous"},
        "gear": {"size": 3, "action_type": "discrete"},
    }
    assert info == {
        "type": "env_info",
        "observation_space": [observation] * 2,
        "action_space": [action] * 2,
        "n_agents": 2,
        "agent_policy_names": ["shared_policy"] * 2,
    }


def test_reset_and_step(trainer):
    one = trainer(options={"seed": 4})
    begun = one.ask({"type": "reset"})
    start = np.random.Generator(np.random.PCG64(np.random.SeedSequence(4))).random(2)
    assert begun["type"] == "reset"
    assert begun["info"] == [{"episode": 1, "array": [0, 1]}]
    assert begun["obs"][0]["position"] == start.tolist()
    assert begun["obs"][0]["level"] == 0
    assert bytes.fromhex(begun["obs"][0]["camera_2d"]) == b"\xff\x01\x10" + bytes(15)
    moved = one.ask({"type": "action", "action": [ACTION]})
    assert moved == {
        "type": "step",
        "obs": [{**moved["obs"][0], "position": np.add(start, [1, 0]).tolist(), "level": 1}],
        "reward": [0.5],
        "done": [False],
        "info": [{"gear": 1, "terminated": False, "truncated": False}],
    }


def test_an_action_is_repeated_until_the_episode_ends(trainer):
    one = trainer(length=6, options={"action_repeat": 4})
    one.ask({"type": "reset"})
    moved = one.ask({"type": "action", "action": [ACTION]})
    assert (moved["reward"], moved["done"]) == ([2.0], [False])
    moved = one.ask({"type": "action", "action": [ACTION]})
    assert (moved["reward"], moved["done"]) == ([1.0], [True])


def test_agents_go_on_by_themselves_and_the_last_observation_is_kept(trainer, cart):
    one = trainer(Worlds([cart(length=2), cart(length=3)]))
    begun = one.ask({"type": "reset"})
    one.ask({"type": "action", "action": [ACTION, ACTION]})
    moved = one.ask({"type": "action", "action": [ACTION, ACTION]})
    assert moved["done"] == [True, False]
    ended, other = moved["info"]
    last = np.add(np.add(begun["obs"][0]["position"], [1, 0]), [1, 0])
    assert ended["terminal_observation"]["position"] == last.tolist()
    assert (ended["terminated"], ended["truncated"]) == (False, True)
    assert ended["TimeLimit.truncated"] is True
    assert moved["obs"][0]["level"] == 0, "the next episode has begun"
    assert "terminal_observation" not in other
    assert moved["obs"][1]["level"] == 2
    moved = one.ask({"type": "action", "action": [ACTION, ACTION]})
    assert moved["done"] == [False, True]


def test_terminated_is_not_truncated(trainer):
    one = trainer(worlds := Worlds([open_worlds("gym/CartPole-v1").environments[0]]))
    one.ask({"type": "reset"})
    done = False
    while not done:
        moved = one.ask({"type": "action", "action": [{"action": 1}]})
        done = moved["done"][0]
    info = moved["info"][0]
    assert (info["terminated"], info["truncated"], info["TimeLimit.truncated"]) == (
        True,
        False,
        False,
    )
    assert abs(info["terminal_observation"]["obs"][2]) > 0.2
    worlds.close()


def test_an_action_before_a_reset_begins_episodes(trainer):
    moved = trainer(num=2).ask({"type": "action", "action": [ACTION] * 2})
    assert [seen["level"] for seen in moved["obs"]] == [1, 1]


def test_seeds_make_episodes_repeatable_and_differ_between_agents(trainer):
    first, second = (trainer(num=2, options={"seed": 7}).ask({"type": "reset"}) for _ in range(2))
    assert first == second
    one, other = (seen["position"] for seen in first["obs"])
    assert one != other
    third = trainer(num=2)
    assert third.ask({"type": "reset", "seed": 7}) == first
    assert third.ask({"type": "reset"})["obs"] != first["obs"]


def test_call(trainer, cart):
    one = trainer(Worlds([cart(name="a"), cart(name="b")]))
    assert one.ask({"type": "call", "method": "who"}) == {
        "type": "call",
        "returns": [{"name": "a", "steps": 0}, {"name": "b", "steps": 0}],
    }


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("whom", 'Did you mean "who"?'),
        ("_who", "public method"),
        ("__class__", "public method"),
        (None, "public method"),
        ("close", "its own message type"),
        ("length", "has no method"),
        ("needs", "missing 1 required"),
    ],
)
def test_what_cannot_be_called_is_named(trainer, method, said):
    one = trainer()
    answer = one.ask({"type": "call", "method": method})
    assert answer["type"] == "error"
    assert said in answer["message"]
    assert one.ask({"type": "reset"})["type"] == "reset"


def test_close_ends_the_service_without_an_answer(trainer):
    one = trainer()
    one.send({"type": "close"})
    assert one.service_ends()
    assert one.socket.recv(10) == b""


# Actions and observations of many kinds ----------------------------------------------------------


class Echo(gymnasium.Env):
    """Has the spaces that it is given, and keeps its actions."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.seen = self.observation_space.sample()
        return self.seen, {}

    def step(self, action):
        self.actions.append(action)
        return self.seen, 0.0, False, False, {}


UNIT = spaces.Box(-1, 1, (2,), np.float64)


@pytest.mark.parametrize(
    ("space", "given", "taken"),
    [
        (UNIT, {"action": [0.1, -0.7]}, [0.1, -0.7]),
        (UNIT, {"action": [3, -1e300]}, [1.0, -1.0]),
        (spaces.Box(-2, 4, (2, 1), np.float64), {"action": [1, 0]}, [[4.0], [1.0]]),
        (spaces.Box(-np.inf, np.inf, (1,), np.float32), {"action": [12.5]}, [12.5]),
        (spaces.Box(0, 10, (2,), np.int64), {"action": [0.1, -1]}, [6, 0]),
        (spaces.Box(0, 3, (), np.float64), {"action": [1]}, 3.0),
        (spaces.Discrete(4, start=-2), {"action": 3}, 1),
        (spaces.Discrete(4), {"action": 3.0}, 3),
        (spaces.MultiDiscrete([2, 3]), {"action_0": 1, "action_1": 2}, [1, 2]),
        (spaces.MultiBinary(2), {"action_0": 0, "action_1": 1}, [0, 1]),
        (
            spaces.Tuple([UNIT, spaces.Discrete(2)]),
            {"action_0": [0, 1], "action_1": 1},
            ([0, 1], 1),
        ),
        (
            spaces.Dict({"a": spaces.Dict({"b": UNIT}), "c": spaces.Discrete(2)}),
            {"a.b": [0.5, 0.5], "c": 0},
            {"a": {"b": [0.5, 0.5]}, "c": 0},
        ),
        (spaces.Dict({}), {}, {}),
    ],
)
def test_actions_reach_the_environment_in_its_own_space(trainer, space, given, taken):
    echo = Echo(UNIT, space)
    one = trainer(Worlds([echo]))
    described = one.ask({"type": "env_info"})["action_space"][0]
    assert described.keys() == given.keys()
    assert one.ask({"type": "action", "action": [given]})["type"] == "step"
    assert space.contains(echo.actions[0])
    assert plain(echo.actions[0]) == plain(taken)


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return np.asarray(value).tolist()


@pytest.mark.parametrize(
    ("space", "key", "size"),
    [
        (UNIT, "obs", [2]),
        (spaces.Box(-1, 1, ()), "obs", [1]),
        (spaces.Box(0, 255, (4, 4, 3), np.uint8), "camera_2d", [4, 4, 3]),
        (spaces.Dict({"eye_2d": spaces.Box(0, 255, (4, 4, 1), np.uint8)}), "eye_2d", [4, 4, 1]),
        (spaces.Dict({"a": spaces.Dict({"b": UNIT})}), "a.b", [2]),
        (spaces.Tuple([UNIT]), "obs_0", [2]),
        (spaces.MultiBinary(3), "obs", [3]),
        (spaces.Box(0, 1, (2,), np.bool_), "obs", [2]),
        (spaces.MultiDiscrete([2, 3]), "obs", [2]),
        (spaces.Box(-np.inf, np.inf, (0,)), "obs", [0]),
    ],
)
def test_observations_of_each_kind_are_told_in_full(trainer, space, key, size):
    echo = Echo(space, UNIT)
    one = trainer(Worlds([echo]), options={"seed": 1})
    described = one.ask({"type": "env_info"})["observation_space"][0]
    assert described.keys() == {key}
    assert described[key]["size"] == size
    seen = one.ask({"type": "reset"})["obs"][0][key]
    value = echo.seen
    while isinstance(value, (dict, tuple)):
        value = next(iter(value.values())) if isinstance(value, dict) else value[0]
    if "2d" in key:
        seen = np.frombuffer(bytes.fromhex(seen), np.uint8)
    assert np.array_equal(np.reshape(seen, size), np.reshape(value, size))


@pytest.mark.parametrize(
    ("observation", "action", "said"),
    [
        (spaces.Text(5), UNIT, "no fixed layout"),
        (UNIT, spaces.Text(5), "no fixed layout"),
        (spaces.Dict({"lidar2d": UNIT}), UNIT, "Rename the part"),
        (spaces.Dict({"a.b": UNIT, "a": spaces.Dict({"b": UNIT})}), UNIT, 'both be called "a.b"'),
    ],
)
def test_spaces_that_godot_rl_cannot_say(observation, action, said):
    with pytest.raises((ConfigError, UsageError), match=said):
        GodotRL().service(Worlds([Echo(observation, action)]), address="127.0.0.1", port=1)


def test_what_a_message_cannot_carry_is_no_reason_to_fail(trainer, cart):
    one = trainer()
    assert one.ask({"type": "reset"})["info"][0].keys() == {"episode", "array"}


# Framing ----------------------------------------------------------------------------------------


def test_requests_split_at_every_byte_and_in_one_piece(trainer):
    messages = [
        {"type": "env_info"},
        {"type": "reset", "seed": 1},
        {"type": "call", "method": "who"},
    ]
    one = trainer()
    expected = [one.ask(message) for message in messages]
    stream = b"".join(one.framed(message) for message in messages)
    one.socket.sendall(stream)
    expected[1]["info"][0]["episode"] = 2
    assert [one.answer() for _ in messages] == expected
    for byte in stream:
        one.socket.sendall(bytes([byte]))
        one.service.poll(0.05)
    expected[1]["info"][0]["episode"] = 3
    assert [one.answer() for _ in messages] == expected


def test_text_beyond_ascii(trainer, cart):
    one = trainer(Worlds([cart(name="größer ∞")]))
    assert one.ask({"type": "call", "method": "who"})["returns"][0]["name"] == "größer ∞"
