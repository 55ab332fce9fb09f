"""The clients of godot-gym: environments of Gymnasium, and what they say when things go wrong."""

from __future__ import annotations

import socket
import struct
import threading

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core import Field, Robot, World, plugins
from physx_core.errors import (
    ConfigError,
    RemoteClosedError,
    RemoteError,
    RemoteProtocolError,
    RemoteTimeoutError,
    UsageError,
)
from physx_core.remote import (
    GodotGymClient,
    GodotGymEnv,
    Messages,
    RLAgent,
    RLEnvironment,
    RLEnvWorld,
    connect,
    serve,
)
from physx_core.remote.messages import fill

pytestmark = pytest.mark.filterwarnings("ignore:.*Box observation space:UserWarning")


class EverySpace(gymnasium.Env):
    """Says what its actions were; its spaces have parts of every kind."""

    PARTS = {
        "box": spaces.Box(-np.inf, np.inf, (2, 3), np.float64),
        "bounds": spaces.Box(np.array([-1, -np.inf], "f4"), np.array([np.inf, 2], "f4")),
        "single": spaces.Box(-1, 1, (), np.float32),
        "picture": spaces.Box(0, 255, (4, 5, 3), np.uint8),
        "whole": spaces.Box(-9, 9, (3,), np.int16),
        "one": spaces.Discrete(5, start=-2),
        "bits": spaces.MultiBinary((2, 2)),
        "several": spaces.MultiDiscrete([3, 4]),
        "pair": spaces.Tuple([spaces.Discrete(2), spaces.Dict({"x y": spaces.Discrete(3)})]),
    }
    observation_space = action_space = spaces.Dict(PARTS)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.count = 0
        return self.observation_space.sample(), {"options": options, "array": np.arange(3)}

    def step(self, action):
        self.count += 1
        assert self.action_space.contains(action)
        return action, 0.1, self.count == 3, self.count == 2, {}


@pytest.fixture
def drive(in_thread):
    """Serve an environment in a thread and return a client of it."""
    clients = []

    def drive(environment, protocol_options=None, **options):
        service = in_thread(environment, **(protocol_options or {}))
        host, port = service.address
        clients.append(connect(f"{host}:{port}", "godot-gym", **options))
        return clients[-1]

    yield drive
    for client in clients:
        client.close()


def same(first, second):
    """Return whether two values are the same in structure, type and every bit."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[k], second[k]) for k in first)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    first, second = np.asarray(first), np.asarray(second)
    return first.dtype == second.dtype and np.array_equal(first, second)


# Environments of Gymnasium ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "Blackjack-v1"])
def test_the_checker_of_gymnasium(drive, name):
    check_env(drive(f"gym/{name}"), skip_render_check=True)


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "Acrobot-v1"])
def test_the_same_trajectory_as_in_process(drive, name):
    here, there = gymnasium.make(name), drive(f"gym/{name}")
    assert there.observation_space == here.observation_space
    assert there.action_space == here.action_space
    here.action_space.seed(4)
    for seed in (7, 7, 8, None):
        first, second = here.reset(seed=seed), there.reset(seed=seed)
        assert same(first[0], second[0])
        for _ in range(40):
            action = here.action_space.sample()
            first, second = here.step(action), there.step(action)
            assert same(first[0], second[0])
            assert first[1:4] == second[1:4]
            if first[2] or first[3]:
                break


def test_every_kind_of_space_and_value(drive):
    env = drive(EverySpace)
    assert env.observation_space == EverySpace.observation_space
    observation, info = env.reset(seed=3, options={"how": ["far", None]})
    assert env.observation_space.contains(observation)
    assert info == {"options": {"how": ["far", None]}, "array": [0, 1, 2]}
    here = EverySpace()
    assert same(observation, here.reset(seed=3)[0])
    env.action_space.seed(1)
    for ended in ((False, False), (False, True)):
        action = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        assert same(observation, action)
        assert (terminated, truncated) == ended
        assert (reward, info) == (0.1, {})
    # The last observation stays until the next reset, and no step is made before it.
    data = env.client.request({"observation": env.requested_observation})
    assert same(env.observation_of(data), action)
    assert env.ended_of(data) == (False, True)
    with pytest.raises(RemoteError, match="reset first"):
        env.step(action)
    env.reset()
    assert env.step(action)[2:4] == (False, False)


def test_repeated_actions_add_their_rewards_and_stop_at_the_end(drive):
    env = drive(EverySpace, repeat_action=5)
    env.reset(seed=1)
    *_, reward, terminated, truncated, _ = env.step(env.action_space.sample())
    assert (terminated, truncated) == (False, True)
    assert reward == pytest.approx(0.2)


@pytest.mark.parametrize("action", [[1, 2], 1.5, "left", None, {}, [[1]]])
def test_an_action_of_another_shape(drive, action):
    env = drive("gym/CartPole-v1")
    env.reset()
    with pytest.raises(RemoteError, match="The action"):
        env.client.step(action, env.requested_observation)
    env.step(1)


def test_what_the_environment_raises_is_told(drive):
    class Failing(EverySpace):
        def step(self, action):
            raise ValueError("the wheel came off")

    env = drive(Failing)
    with pytest.raises(RemoteError, match="reset first"):
        env.step(env.action_space.sample())
    env.reset(seed=1)
    with pytest.raises(RemoteError, match="ValueError: the wheel came off"):
        env.step(env.action_space.sample())
    env.reset(seed=1)


def test_what_cannot_be_served(scene_class):
    class Texts(EverySpace):
        observation_space = spaces.Dict({"say": spaces.Text(5)})

    with pytest.raises(UsageError, match="no fixed layout"):
        serve(Texts, "godot-gym")
    with pytest.raises(UsageError, match="serves one world"):
        serve("gym/CartPole-v1", "godot-gym", num_worlds=2)


# Environments over an engine --------------------------------------------------------------------


class Cart(RLAgent):
    def __init__(self, simulation):
        self.simulation = simulation

    def set_action(self, action):
        self.simulation.set_torques(np.array([action[0], 0.0]))

    def get_data(self, request, storage):
        q, v = self.simulation.positions(), self.simulation.velocities()
        fill(storage, state=np.concatenate([q, v]))


class Track(RLEnvWorld):
    def __init__(self, simulation):
        self.simulation = simulation

    def get_data(self, request, storage):
        slider = self.simulation.positions()[0]
        fill(storage, reward=1.0, terminated=bool(abs(slider) > 0.2), slider=slider)


class CartPole(RLEnvironment):
    """A cart with a pole on an engine; one physics step in a frame."""

    def __init__(self, backend="dart"):
        super().__init__()
        self.backend = backend

    def _ready(self):
        world = World(robots=[Robot("cartpole")], period=1 / 60)
        self.simulation = plugins.resolve("backend", self.backend).build(world)
        self.agent, self.world = Cart(self.simulation), Track(self.simulation)
        self.messages = Messages.of_fields(
            agent=[Field("state", (4,))],
            world=[("reward", float), ("terminated", bool), ("slider", float)],
        )
        self.action_space = spaces.Box(-10, 10, (1,), np.float64)

    def _reset(self):
        self.simulation.set_state(self.rng.uniform(-0.05, 0.05, 2), self.rng.uniform(-1, 1, 2))


@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_the_same_trajectory_on_an_engine(drive, backend):
    env = drive(CartPole(backend), repeat_action=2)
    world = World(robots=[Robot("cartpole")], period=1 / 60)
    with plugins.resolve("backend", backend).build(world) as simulation:
        for seed in (1, 2, 1):
            rng = np.random.default_rng(seed)
            simulation.set_state(rng.uniform(-0.05, 0.05, 2), rng.uniform(-1, 1, 2))
            observation, _ = env.reset(seed=seed)
            env.action_space.seed(seed)
            for _ in range(25):
                state = np.concatenate([simulation.positions(), simulation.velocities()])
                assert same(observation["state"], state)
                action = env.action_space.sample()
                simulation.set_torques(np.array([action[0], 0.0]))
                simulation.step(2)
                observation, reward, terminated, truncated, info = env.step(action)
                assert (reward, truncated) == (1.0, False)
                assert terminated == (abs(simulation.positions()[0]) > 0.2)
                assert info == {"slider": simulation.positions()[0]}


def test_the_checker_of_gymnasium_on_an_engine(drive):
    check_env(drive(CartPole()), skip_render_check=True)


@pytest.mark.parametrize(("period", "steps"), [(1 / 60, 1), (1 / 240, 4), (1e-3, 17), (0.05, 1)])
def test_how_many_physics_steps_a_frame_has(start, peer_class, period, steps):
    class Free(CartPole):
        def _ready(self):
            world = World(robots=[Robot("cartpole")], period=period)
            self.simulation = plugins.resolve("backend", self.backend).build(world)
            self.agent, self.world = Cart(self.simulation), Track(self.simulation)

    service = start(Free())
    peer = peer_class(service.address, service)
    assert service.environment.frame_time == steps * period
    for frames in (0, 1, 4, 10):
        before = service.environment.simulation.frame
        peer.ask({"config": {"environment": {"repeat_action": frames}}})
        peer.ask({"action": [0]})
        service.poll(0.01)
        assert service.environment.simulation.frame - before == frames * steps
    service.environment.frame_steps = 3
    peer.ask({"action": [0]})
    assert service.environment.simulation.frame - before == 10 * steps + 30
    peer.leave()


def test_steps_of_ones_own(start, scene_class, peer_class):
    class Before(scene_class):
        def _step(self, action):
            self.calls.append(("before", self.agent.frames))
            yield from super()._step(action)
            self.calls.append(("behind", self.agent.frames))

    class Instead(scene_class):
        async def _step(self, action):
            self.calls.append(("before", self.agent.frames))
            self.agent.set_action(action)
            await self.physics_frames_timer.start()  # paused: nothing moves
            self.paused = False
            await self.physics_frames_timer.start()
            self.paused = True
            self.calls.append(("behind", self.agent.frames))

    class Plain(scene_class):
        def _step(self, action):
            self.calls += [("before", 0), ("behind", 4)]

    for kind in (Before, Instead, Plain):
        service = start(kind())
        peer = peer_class(service.address, service)
        peer.ask({"action": [1]})
        calls = service.environment.calls
        assert [call for call in calls if call[0] != "set_action"][:2] == [
            ("before", 0),
            ("behind", 4),
        ]
        assert service.environment.paused
        peer.leave()


def test_an_environment_is_also_known_by_its_reference(start, tmp_path, monkeypatch):
    text = "from physx_core.remote import RLEnvironment\n\n\nclass Room(RLEnvironment):\n"
    script = tmp_path / "room.py"
    script.write_text(text + "    def _ready(self):\n        self.messages = None\n")
    service = start(f"{script}:Room")
    assert type(service.environment).__name__ == "Room"


# Clients ----------------------------------------------------------------------------------------


def test_a_server_that_says_nothing_of_itself(in_thread, scene_class):
    class Silent(scene_class):
        def _described(self):
            return "{}"

        def _send_response(self, observation_request):
            if "environment" in observation_request:
                self.communication.put_message(self.messages.Message())  # as a Godot application
            else:
                super()._send_response(observation_request)

    service = in_thread(Silent(), clients="serve")
    with pytest.raises(RemoteError, match="Give messages="):
        GodotGymEnv(service.address)
    messages = service.environment.messages
    with pytest.raises(RemoteError, match="give action_space="):
        GodotGymEnv(service.address, messages=messages, observation_space=spaces.Discrete(2))

    class Walk(GodotGymEnv):
        def observation_of(self, data):
            return data["agent"]["a"]

        def ended_of(self, data):
            return False, bool(data["world"]["done"])

    env = Walk(
        service.address,
        messages=messages.Message,
        observation_space=spaces.Box(-9, 9, (1,), np.float32),
        action_space=spaces.Box(-1, 1, (1,), np.float32),
        requested_observation={"agent": ["a"], "world": ["done"]},
        time_speed=100,
        repeat_action=2,
    )
    assert env.reset()[0] == [0.0]
    assert env.step(np.ones(1, np.float32)) == ([8.0], 0.0, False, True, {"big": -1})
    env.close()


def test_a_client_with_messages_that_are_none():
    with pytest.raises(ConfigError, match="no message Message"):
        GodotGymClient(np)
    with pytest.raises(ConfigError, match="no message Message"):
        GodotGymClient(Field)


class Stub:
    """A server that answers with the bytes that it is given, and then ends the connection."""

    def __init__(self, *answers):
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = self.listener.getsockname()
        self.answers, self.wait = answers, threading.Event()
        self.thread = threading.Thread(target=self._serve)
        self.thread.start()

    def _serve(self):
        connection, _ = self.listener.accept()
        with connection:
            for answer in self.answers:
                connection.recv(65536)
                if answer is None:
                    self.wait.wait(30)
                else:
                    connection.sendall(answer)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.wait.set()
        self.thread.join(30)
        self.listener.close()


MESSAGES = Messages.of_fields(agent=[Field("a", (1,))])


@pytest.mark.parametrize("part", [b"", b"\x08\0", b"\x08\0\0\0", b"\x08\0\0\0\x0a\x06"])
def test_an_end_of_the_connection_raises(part):
    with Stub(bytes(4), part) as stub, GodotGymClient(MESSAGES, stub.address) as client:
        assert client.request({}) == {"agent": None, "world": None}
        with pytest.raises(RemoteClosedError, match="ended the connection"):
            client.request({"observation": {"agent": []}})
        with pytest.raises(RemoteClosedError, match="is closed: "):
            client.request({})


def test_an_answer_that_does_not_come_in_time():
    with Stub(None) as stub, GodotGymClient(MESSAGES, stub.address, timeout=0.05) as client:
        with pytest.raises(RemoteTimeoutError, match=r"within 0\.05 s"):
            client.request({})
        with pytest.raises(RemoteClosedError, match="took longer"):
            client.request({})


def test_an_answer_that_is_too_long_or_nonsense():
    lie = struct.pack("<I", 1 << 31)
    with Stub(lie) as stub, GodotGymClient(MESSAGES, stub.address) as client:
        with pytest.raises(RemoteProtocolError, match="2147483648 bytes"):
            client.request({})
    nonsense = struct.pack("<I", 4) + b"\x0a\xff\xff\xff"
    with Stub(nonsense) as stub, GodotGymClient(MESSAGES, stub.address) as client:
        with pytest.raises(RemoteProtocolError, match="4 bytes is none of the messages"):
            client.request({})


@pytest.mark.parametrize("cut", range(1, 22))
def test_answers_that_come_in_pieces(cut):
    body = MESSAGES.Message()
    fill(body.agent_data, a=[3.0])
    data = body.SerializeToString()
    answer = struct.pack("<I", len(data)) + data
    listener = socket.create_server(("127.0.0.1", 0))
    with listener, GodotGymClient(MESSAGES, listener.getsockname()) as client:
        connection, _ = listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection:
            connection.sendall(answer[:cut])
            rest = threading.Timer(0.005, connection.sendall, [answer[cut:]])
            rest.start()
            assert client.request({})["agent"]["a"] == [3.0]
            rest.join()


def test_closing_and_addresses():
    with pytest.raises(RemoteTimeoutError, match="Start the server first"):
        with socket.create_server(("127.0.0.1", 0)) as taken:
            address = taken.getsockname()
        GodotGymClient(MESSAGES, address, connect_timeout=0.05)
    with pytest.raises(ConfigError, match='give "host:port"'):
        connect("localhost", "godot-gym")
    with Stub() as stub:
        client = GodotGymClient(MESSAGES, stub.address)
        client.close()
        client.close()
        with pytest.raises(RemoteClosedError, match="closed here"):
            client.request({})


def test_a_client_waits_for_its_server(in_thread, scene_class):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = taken.getsockname()
    later = threading.Timer(0.2, in_thread, [scene_class()], {"port": address[1]})
    later.start()
    with GodotGymClient(MESSAGES, address, connect_timeout=30) as client:
        assert client.request({}) == {"agent": None, "world": None}
    later.join()
