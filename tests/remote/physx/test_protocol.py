"""The protocol physx: one world, several worlds, snapshots and onlookers, over real sockets."""

from __future__ import annotations

import contextlib
import threading
import warnings
from collections import OrderedDict
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space

from physx_core.errors import ActionError, ConfigError, EpisodeError, UsageError
from physx_remote import (
    PhysxClient,
    PhysxEnv,
    PhysxObserver,
    connect,
    connect_vector,
)
from physx_remote.errors import RemoteClosedError, RemoteError, RequestError

TOKEN = "0123456789abcdef"
PATIENCE = 30.0

ALL = spaces.Dict(
    OrderedDict(
        z=spaces.Box(-1, 1, (2, 3), np.float32),
        a=spaces.Tuple([spaces.Discrete(5, start=2), spaces.MultiBinary(4)]),
        m=spaces.MultiDiscrete([3, 4], dtype=np.int32),
        scalar=spaces.Box(0, 255, (), np.uint8),
        empty=spaces.Box(0, 1, (0,), np.float64),
    )
)


class Echo(gymnasium.Env):
    """Observes its last action."""

    observation_space = action_space = ALL

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {"options": options, "seed": seed}

    def step(self, action):
        assert self.action_space.contains(action), action
        return action, 0.5, False, False, {"object": object(), "array": np.arange(3)}


class Episodes(gymnasium.Env):
    """Counts its steps; its episodes end after lengths that it draws."""

    observation_space = spaces.Dict(n=spaces.Discrete(100), x=spaces.Box(-9, 9, (2,), np.float64))
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(self, large=0):
        self.render_mode = "rgb_array"
        if large:
            self.observation_space = spaces.Box(0, np.inf, (large,), np.float64)
        self.large = large

    def observe(self):
        if self.large:
            return np.full(self.large, float(self.n))
        return {"n": np.int64(self.n), "x": self.x.copy()}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n, self.end = 0, int(self.np_random.integers(2, 6))
        self.x = self.np_random.random(2)
        return self.observe(), {"end": self.end}

    def step(self, action):
        if np.isnan(action).any():
            raise ArithmeticError("no number")
        self.n += 1
        self.x = self.x + action
        over = self.n >= self.end and not self.large
        info = {"ended": self.n} if over else {}
        return self.observe(), float(action[0]), over and self.end % 2 == 0, over, info

    def snapshot(self):
        return self.n, self.end, self.x.copy()

    def restore(self, state):
        self.n, self.end, self.x = state[0], state[1], state[2].copy()

    def render(self):
        return np.full((2, 2, 3), self.n, np.uint8)


class Locked(Episodes):
    """Holds something that only its process can have."""

    snapshot = None

    def __init__(self, **options):
        super().__init__(**options)
        self.lock = threading.Lock()


@pytest.fixture
def place(serving):
    """Serve an environment and return its address."""
    return lambda *args, **options: "{}:{}".format(*serving(*args, **options).address)


@pytest.fixture
def client(place):
    """A client of three worlds of `Episodes`, and its `address`."""
    address = place(Episodes, num_worlds=3)
    host, port = address.split(":")
    with PhysxClient((host, int(port)), token=TOKEN) as client:
        client.address = address
        yield client


# One world ---------------------------------------------------------------------------------------


def test_every_kind_of_space_goes_there_and_back(place, caplog):
    with connect(place(Echo), token=TOKEN) as env:
        assert env.observation_space == ALL and env.action_space == ALL
        assert list(env.observation_space.spaces) == list(ALL.spaces)
        observation, info = env.reset(seed=3, options={"deep": [1, {"x": None}]})
        assert info == {"options": {"deep": [1, {"x": None}]}, "seed": 3}
        assert ALL.contains(observation)
        for _ in range(20):
            action = env.action_space.sample()
            echo, reward, terminated, truncated, info = env.step(action)
            assert ALL.contains(echo)
            np.testing.assert_equal(echo, action)
            assert (reward, terminated, truncated) == (0.5, False, False)
            assert [type(v) for v in (reward, terminated, truncated)] == [float, bool, bool]
            assert list(info) == ["array"] and info["array"].tolist() == [0, 1, 2]
    assert caplog.text.count("object") == 1, "what cannot travel is named once"


def test_the_environment_checker_has_nothing_to_say(place):
    with connect(place(Episodes), token=TOKEN) as env, warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
    assert env.metadata == Episodes.metadata and env.render_mode == "rgb_array"


def test_the_same_trajectory_in_process_and_over_both_protocols(place, in_thread):
    service = in_thread("physx/Cartpole-v0")
    rng = np.random.default_rng(5)
    actions = rng.integers(0, 3, 60).tolist()
    found = []
    here = gymnasium.make("physx_gym:physx/Cartpole-v0", disable_env_checker=True)
    address = "{}:{}".format(*service.address)
    for env in (
        here,
        connect(address, "godot-gym"),
        connect(place("physx/Cartpole-v0"), "physx", token=TOKEN),
    ):
        with contextlib.closing(env):
            trajectory = [env.reset(seed=11)[0]]
            for action in actions:
                observation, reward, terminated, truncated, _ = env.step(action)
                trajectory += [observation, reward, terminated, truncated]
                if terminated or truncated:
                    trajectory.append(env.reset(seed=12)[0])
        found.append(trajectory)
    assert len(found[0]) > 4 * len(actions)
    np.testing.assert_equal(found[1], found[0])
    np.testing.assert_equal(found[2], found[0])


def test_invalid_actions(client):
    env = PhysxEnv(client)
    env.reset(seed=0)
    for action in ([1.0], "push", None, np.ones((2, 2))):
        with pytest.raises(ActionError):
            env.step(action)
    with pytest.raises(ConfigError, match="no world 3"):
        PhysxEnv(client, 3)
    env.step([0.5, 0.5])


def test_rendering(client):
    client.reset()
    client.step(client.actions.stack(np.zeros((3, 2))))
    assert client.render(2).tolist() == np.full((2, 2, 3), 1).tolist()


# Several worlds -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_worlds_do_what_gymnasium_does_one_after_the_other(place, mode):
    wanted = SyncVectorEnv([Episodes] * 3, autoreset_mode=mode)
    found = connect_vector(place(Episodes, num_worlds=3), token=TOKEN, autoreset_mode=mode.value)
    assert found.metadata["autoreset_mode"] is mode
    assert found.single_action_space == wanted.single_action_space
    assert found.observation_space == batch_space(Episodes.observation_space, 3)
    with contextlib.closing(wanted), contextlib.closing(found):
        np.testing.assert_equal(found.reset(seed=4), wanted.reset(seed=4))
        rng = np.random.default_rng(0)
        for _ in range(25):
            actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
            one, other = found.step(actions), wanted.step(actions)
            np.testing.assert_equal(_listed(one), _listed(other))
            assert found.observation_space.contains(one[0])
            over = one[2] | one[3]
            if mode is AutoresetMode.DISABLED and over.any():
                with pytest.raises(EpisodeError, match="reset_mask"):
                    found.step(actions)
                options = {"reset_mask": over}
                one, other = (env.reset(options=dict(options)) for env in (found, wanted))
                np.testing.assert_equal(one, other)


def test_a_subset_of_the_worlds_is_stepped(client):
    begin = client.reset(seeds=[1, 2, 3]).arrays["observation1"]
    actions = np.array([[1.0, 0.0], [0.5, 0.0]], np.float32)
    rows = client.step({"action0": actions}, [2, 0])
    assert rows.arrays["reward"].tolist() == [1.0, 0.5]
    moved = rows.arrays["observation1"] - begin[[2, 0]]
    np.testing.assert_allclose(moved, actions, atol=1e-12)
    again = client.reset([1], seeds=[2])
    assert again.arrays["observation1"].tolist() == begin[[1]].tolist()


@pytest.mark.parametrize("worlds", [[3], [-1], [0, 0], []])
def test_worlds_that_do_not_exist(client, worlds):
    with pytest.raises(RequestError, match="Worlds must be a list"):
        client.reset(worlds)
    with pytest.raises(RequestError):
        client.step({"action0": np.zeros((len(worlds), 2), np.float32)}, worlds)
    client.reset()


def test_vector_environments_check_what_they_are_given(place):
    with contextlib.closing(connect_vector(place(Episodes, num_worlds=2), token=TOKEN)) as env:
        for seed, options in ((None, {"reset_mask": np.array([True, False])}), ([1], None)):
            with pytest.raises(ConfigError):
                env.reset(seed=seed, options=options)
        env.reset(seed=[1, None])
        with pytest.raises(ActionError, match="3 actions for 2"):
            env.step(np.zeros((3, 2)))
        with pytest.raises(ConfigError, match="no world"):
            env.reset(options={"reset_mask": np.zeros(2, np.bool_)})
        assert [picture[0, 0, 0] for picture in env.render()] == [0, 0]
    with pytest.raises(ConfigError, match="NextStep"):
        connect_vector(place(Episodes), token=TOKEN, autoreset_mode="never")


# Snapshots ------------------------------------------------------------------------------------


def test_a_snapshot_of_one_world_goes_on_in_another(client):
    client.reset(seeds=[0, 1, 2])
    push = client.actions.stack(np.full((1, 2), 0.25))
    client.step(push, [0])
    number = client.snapshot(0)
    first = [client.step(push, [0]).arrays for _ in range(2)]
    shown = client.restore(number, 2)
    assert shown.arrays["observation0"].tolist() == [1]
    second = [client.step(push, [2]).arrays for _ in range(2)]
    np.testing.assert_equal(second, first)
    assert client.forget(number) and not client.forget(number)
    with pytest.raises(RequestError, match="no snapshot"):
        client.restore(number)


def test_snapshots_that_cannot_be_made(place):
    with connect(place(Locked), token=TOKEN) as env:
        assert not env.client.has_snapshots
        with pytest.raises(RequestError, match="not started"):
            env.snapshot()
        env.reset()
        with pytest.raises(UsageError, match="no snapshots"):
            env.snapshot()
    with connect(place(Episodes, max_snapshots=1), token=TOKEN) as env:
        env.reset()
        env.snapshot()
        with pytest.raises(RequestError, match="max_snapshots"):
            env.snapshot()


def test_a_robot_goes_back_to_where_it_was(place):
    with connect(place("physx/Cartpole-v0"), token=TOKEN) as env:
        env.reset(seed=2)
        number = env.snapshot()
        first = [env.step(2) for _ in range(5)]
        env.restore(number)
        np.testing.assert_equal([env.step(2) for _ in range(5)], first)


# Onlookers --------------------------------------------------------------------------------------


def test_an_observer_gets_what_the_actor_gets(client):
    with PhysxObserver(client.address, token=TOKEN) as observer:
        assert len(observer.last().worlds) == 0, "nothing has begun"
        begin = client.reset(seeds=[1, 2, 3])
        seen = observer.next(PATIENCE)
        assert seen.is_reset and seen.action is None and seen.number == 1
        assert seen.infos == list(begin.infos)
        actions = np.array([[1.0, 0.0], [0.5, 0.0]], np.float32)
        rows = client.step({"action0": actions}, [2, 0])
        seen = observer.next(PATIENCE)
        assert (seen.worlds.tolist(), seen.is_reset, seen.number) == ([2, 0], False, 2)
        np.testing.assert_equal(seen.action, actions)
        np.testing.assert_equal(seen.observation["x"], rows.arrays["observation1"])
        np.testing.assert_equal(seen.reward, rows.arrays["reward"])
        with PhysxObserver(client.address, token=TOKEN) as late:
            last = late.last()
            assert last.worlds.tolist() == [0, 1, 2] and last.number == 2
            assert last.observation["n"].tolist() == [1, 0, 1]
            assert late.next(0.0) is None
        client.step({"action0": actions}, [2, 0])
        assert observer.next(PATIENCE).number == 3


def test_an_observer_changes_nothing(client):
    from physx_core.net import Kind, decode_error, pack_value
    from physx_remote.physx.link import PhysxLink
    from physx_remote.physx.wire import OBSERVE

    client.reset(seeds=[1, 2, 3])
    link = PhysxLink(_place(client.address), OBSERVE, token=TOKEN)
    for kind, value in (
        (Kind.REQUEST, {"do": "reset"}),
        (Kind.REQUEST, {"do": "snapshot"}),
        (Kind.ACTIONS, {"action0": np.zeros((3, 2), np.float32)}),
    ):
        link.send(pack_value(kind, value, "request", 7))
        frame = link.receive()
        assert (frame.kind, frame.number) == (Kind.REFUSAL, 7)
        assert isinstance(decode_error(frame.payload), RequestError)
    link.close()
    assert client.step({"action0": np.zeros((3, 2), np.float32)}).arrays["reward"].sum() == 0


def test_an_observer_that_does_not_read_delays_nobody(place):
    address = place(Episodes, env_kwargs={"large": 20_000})
    steps = 60
    with connect(address, token=TOKEN) as env, PhysxObserver(address, token=TOKEN) as observer:
        env.reset()
        for _ in range(steps):
            env.step([0.0, 0.0])
        seen = []
        while not seen or seen[-1].number <= steps:
            seen.append(observer.next(PATIENCE))
        assert seen[-1].number == steps + 1 and seen[-1].observation[0, 0] == steps
        assert len(seen) < steps, "it went on with the latest"
        env.step([0.0, 0.0])
        assert observer.next(PATIENCE).number == steps + 2
        assert observer.last().observation[0, 0] == steps + 1


# Who acts ----------------------------------------------------------------------------------------


def test_one_client_acts_and_another_after_it(client):
    client.reset(seeds=[1, 2, 3])
    client.step(client.actions.stack(np.zeros((3, 2))))
    with pytest.raises(RemoteError, match="acts here already"):
        connect(client.address, token=TOKEN)
    client.close()
    with pytest.raises(RemoteClosedError, match="closed here"):
        client.reset()
    with PhysxClient(_place(client.address), token=TOKEN) as after:
        rows = after.step(after.actions.stack(np.zeros((3, 2))))
        assert rows.arrays["observation0"].tolist() == [2, 2, 2], "the worlds are as they were"


def _place(address):
    host, _, port = address.rpartition(":")
    return host, int(port)


def _listed(value):
    """Return a value with lists in the place of arrays of objects, which cannot be compared."""
    if isinstance(value, dict):
        return {key: _listed(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_listed(item) for item in value]
    return value.tolist() if getattr(value, "dtype", None) == np.dtype(object) else value
