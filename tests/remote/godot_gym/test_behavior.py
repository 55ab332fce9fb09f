"""Behaviours of godot_gym_api over an engine and a real socket, and of the loop that serves it."""

from __future__ import annotations

import json
import socket
import threading
import time

import numpy as np
import pytest

from physx_core import Field, PhysxError, plugins
from physx_core.errors import ConfigError, UsageError
from physx_remote import (
    GodotGymClient,
    Messages,
    RLAgent,
    RLEnvironment,
    RLEnvWorld,
    connect,
)
from physx_remote.errors import RequestError
from physx_remote.godot_gym.messages import fill
from physx_sim import Robot, World

LIVES = {"observation": {"world": []}}
ALIVE = bytes.fromhex("120d080110ffffffffffffffffff01")
SEE = {"agent": ["state"]}


class Cart(RLAgent):
    def __init__(self, simulation):
        self.simulation = simulation

    def set_action(self, action):
        self.simulation.set_torques(np.array([action[0], 0.0]))

    def get_data(self, request, storage):
        q, v = self.simulation.positions(), self.simulation.velocities()
        fill(storage, state=np.concatenate([q, v]))


class OnDart(RLEnvironment):
    def _ready(self):
        world = World(robots=[Robot("cartpole")], period=1 / 120)
        self.simulation = plugins.resolve("backend", "dart").build(world)
        self.simulation.set_state(np.array([0.0, 0.1]), np.zeros(2))
        self.agent, self.world = Cart(self.simulation), RLEnvWorld()
        self.messages = Messages.of_fields(agent=[Field("state", (4,))])

    def _reset(self):
        self.simulation.set_state(np.array([0.0, 0.1]), np.zeros(2))


@pytest.fixture
def dart(start, peer_class):
    service = start(OnDart())
    peer = peer_class(service.address, service)
    yield peer
    peer.leave()


ACTIONS = [[number - 3.5] for number in range(6)]


def states(peer, message, actions=ACTIONS):
    """Return the answers to actions that are sent in one piece."""
    peer.ask({"reset": 1})
    peer.send(b"".join(message({"action": a, "observation": SEE}) for a in actions))
    return [peer.answer() for _ in actions]


# The state -----------------------------------------------------------------------------------


def test_nothing_moves_without_a_request_even_before_the_first_client(start, peer_class):
    service = start(OnDart())
    simulation = service.environment.simulation
    begin = simulation.positions()
    for _ in range(3):
        service.poll(0.02)
    assert simulation.frame == 0
    peer = peer_class(service.address, service)
    first = peer.ask({"observation": SEE})
    assert np.frombuffer(first[4:36]).tolist() == [*begin, 0.0, 0.0]
    peer.ask({"action": [1]})
    moved = peer.ask({"observation": SEE})
    for _ in range(3):
        service.poll(0.02)
    assert peer.ask({"observation": SEE}) == moved != first
    assert simulation.frame == 8, "an observation makes no step"
    peer.leave()


def test_coalesced_actions_are_the_same_as_single_ones(dart, message):
    together = states(dart, message)
    dart.ask({"reset": 1})
    assert together == [dart.ask({"action": a, "observation": SEE}) for a in ACTIONS]


@pytest.mark.parametrize("piece", [1, 3, 7])
def test_actions_that_come_in_pieces_make_the_same_states(dart, message, piece):
    expected = states(dart, message)
    dart.ask({"reset": 1})
    data = b"".join(message({"action": a, "observation": SEE}) for a in ACTIONS)
    for begin in range(0, len(data), piece):
        dart.send(data[begin : begin + piece])
        dart.arrive()
    assert [dart.answer() for _ in ACTIONS] == expected


def test_time_speed_paces_the_wall_and_never_the_physics(dart, message):
    expected = states(dart, message)
    for speed in (10.0, 100):
        dart.ask({"config": {"environment": {"time_speed": speed}}})
        begin = time.monotonic()
        assert states(dart, message) == expected
        assert time.monotonic() - begin >= len(ACTIONS) * 4 / 60 / speed
    assert dart.service.environment.frame_time == 1 / 60


def test_the_state_is_kept_for_the_next_client(dart, peer_class, message):
    last = states(dart, message)[-1]
    for how in ("fin", "rst"):
        leaving = peer_class(dart.service.address, dart.service)
        dart.leave(how)
        assert leaving.ask({"observation": SEE}) == last
        dart = leaving
    dart.leave()


# The loop ------------------------------------------------------------------------------------


def test_waiting_after_slow_requests_takes_no_time_of_the_processor(peer, scene, message):
    scene.agent.set_action = lambda action: time.sleep(0.03)  # longer than a turn of the loop
    peer.send(message({"action": 1}) * 3)
    assert [peer.answer() for _ in range(3)] == [b""] * 3
    peer.service.poll(0.0)
    begin = time.monotonic()
    peer.service.poll(0.05)
    assert time.monotonic() - begin >= 0.05, "nothing came, so it waited"


def test_busy_client_does_not_starve_others(in_thread, scene, peer_class, message):
    service = in_thread(scene, clients="serve")
    called, over = threading.Event(), threading.Event()
    scene.communication.after(0.01, called.set)

    def hammer():
        eager = peer_class(service.address)
        while not over.is_set():
            assert eager.ask(LIVES) == ALIVE
        eager.leave()

    thread = threading.Thread(target=hammer)
    thread.start()
    other = peer_class(service.address)
    for _ in range(3):
        assert other.ask(LIVES) == ALIVE
    assert called.wait(60), "timers run too"
    over.set()
    thread.join(60)
    other.leave()


@pytest.mark.parametrize("how", ["fin", "rst"])
def test_a_quick_client_that_leaves_makes_room(in_thread, scene, peer_class, how):
    service = in_thread(scene)
    for _ in range(3):
        peer = peer_class(service.address)
        for _ in range(50):
            assert peer.ask(LIVES) == ALIVE
        peer.leave(how)


def test_closing_while_a_client_never_stops_asking(in_thread, scene, peer_class):
    service = in_thread(scene)
    peer = peer_class(service.address)
    for number in range(200):
        if number == 100:
            service.close()
        try:
            if peer.ask(LIVES) is None:
                break
        except OSError:  # closed with a request on its way
            break
    else:
        pytest.fail("the service goes on")
    peer.leave()


# Faults --------------------------------------------------------------------------------------


def test_fifty_clients_where_only_one_is_wanted(start, scene, peer_class, message):
    service = start(scene, clients="refuse")
    first = peer_class(service.address, service)
    assert first.ask(LIVES) == ALIVE
    others = [peer_class(service.address, service) for _ in range(50)]
    for other in others:
        assert other.answer() is None
        other.leave()
    assert first.ask(LIVES) == ALIVE
    first.leave()
    after = peer_class(service.address, service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


@pytest.mark.parametrize("length", [1 << 30, (1 << 32) - 1, (1 << 24) + 1])
def test_false_message_length_allocates_no_memory(peer, peer_class, scene, length):
    peer.send(length.to_bytes(4, "little") + b"x" * 100)
    assert peer.answer() is None
    assert scene.communication.connections == []
    after = peer_class(peer.service.address, peer.service)
    assert after.ask(LIVES) == ALIVE
    after.leave()


def test_another_protocol_altogether(peer, peer_class):
    for said in (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", b"\x16\x03\x01\x02\0" * 20):
        stranger = peer_class(peer.service.address, peer.service)
        stranger.send(said)
        assert stranger.answer() is None
        stranger.leave()
    assert peer.ask(LIVES) == ALIVE


def test_an_error_in_each_request_of_one_segment(peer, message):
    bodies = [b"[", b"[]", b"null", json.dumps(LIVES).encode(), b'{"config": 1}', b"{}"]
    peer.send(b"".join(map(message, bodies)))
    answers = [peer.answer() for _ in bodies]
    assert [bool(a) for a in answers] == [True] * 5 + [False]
    assert answers[3] == ALIVE
    peer.socket.shutdown(socket.SHUT_WR)
    assert peer.answer() is None


def test_a_value_that_a_field_does_not_take_is_named(peer, scene):
    for values, said in (
        ({"a": [1.0, "x"]}, 'The field "a" of AgentData does not accept'),
        ({"a": [[1.0], [2.0, 3.0]]}, 'The field "a" of AgentData does not accept'),
        ({"b": 1}, 'has no field "b". It has: a, frame, d'),
        ({"frame": "text"}, 'The field "frame" of AgentData does not accept'),
    ):
        scene.agent.get_data = lambda request, storage, values=values: fill(storage, **values)
        assert said in peer.error({"observation": {"agent": 1}})
    with pytest.raises(ConfigError, match='"big" of WorldData'):
        fill(scene.messages.Message().world_data, big=1 << 70)
    nested = scene.messages.Message().agent_data
    fill(nested, a=[[1, 2], [3, 4]], d=[np.float32(1.0), 2])
    assert [*nested.a, *nested.d] == [1, 2, 3, 4, 1, 2]


# Mistakes ------------------------------------------------------------------------------------


class Forgetful(RLEnvironment):
    def __init__(self):
        self.calls = []


SERVED = [
    (None, {}, "None is not an environment. Pass an RLEnvironment"),
    (RLAgent, {}, "which is not a Gymnasium environment"),
    (Forgetful, {}, r"Forgetful.__init__ must call super\(\).__init__\(\)"),
    (OnDart, {"env_kwargs": {"size": 3}}, "does not take these arguments"),
    (OnDart, {"env_kwargs": [1]}, "env_kwargs is .* must be a dictionary"),
    (OnDart, {"address": None}, "address is None"),
    (OnDart, {"port": "9090"}, "port is '9090'"),
    (OnDart, {"port": 70_000}, "from 0 to 65535"),
    (OnDart, {"patience": "5"}, "patience is '5'"),
    (OnDart, {"max_request": 1.5}, "max_request is 1.5"),
    ("gym/CartPole-v1", {"num_worlds": "2"}, "num_worlds is '2'"),
]


@pytest.mark.parametrize(("environment", "options", "said"), SERVED)
def test_a_mistake_in_an_argument_of_serve(start, environment, options, said):
    with pytest.raises(PhysxError, match=said):
        start(environment, **options)


def test_an_environment_is_served_once(start, scene_class):
    environment = scene_class()
    with pytest.raises(UsageError, match="takes no env_kwargs"):
        start(environment, env_kwargs={"size": 1})
    start(environment).close()
    with pytest.raises(UsageError, match="already served"):
        start(environment)
    closed = scene_class()
    closed.close()
    with pytest.raises(UsageError, match="create another environment"):
        start(closed)


@pytest.mark.parametrize(("name", "value"), [("repeat_action", -1), ("frame_steps", 0)])
def test_a_mistake_in_a_setting(scene_class, name, value):
    with pytest.raises(PhysxError, match=f"{name} must be an integer"):
        setattr(scene_class(), name, value)


def test_an_invalid_speed(start, scene_class):
    environment = scene_class()
    environment.time_speed = 0
    with pytest.raises(PhysxError, match="time_speed must be a positive number"):
        start(environment)


CONNECTED = [
    ({"timout": 1}, 'Did you mean "timeout"'),
    ({"timeout": 0}, "timeout is 0"),
    ({"connect_timeout": None}, "connect_timeout is None"),
    ({"max_answer": "1 MB"}, "max_answer is '1 MB'"),
    ({"action_space": 3}, "not a gymnasium.Space"),
    ({"requested_observation": ["state"]}, "must be a dictionary"),
    ({"repeat_action": -1}, "repeat_action must be an integer"),
    ({"time_speed": "fast"}, "time_speed must be a positive"),
]


@pytest.mark.parametrize(("options", "said"), CONNECTED)
def test_a_mistake_in_an_argument_of_connect(in_thread, options, said):
    host, port = in_thread("gym/CartPole-v1").address
    with pytest.raises(PhysxError, match=said):
        connect(f"{host}:{port}", "godot-gym", **options)


def test_arrays_may_be_in_requests(in_thread, scene):
    with GodotGymClient(scene.messages, in_thread(scene).address) as client:
        client.step(np.array([0.5]), {})
        with pytest.raises(RequestError, match="neither"):
            client.step(object(), {})
        client.step(np.float32(1), {})
    assert [value for name, value in scene.calls if name == "set_action"] == [[0.5], 1.0]
