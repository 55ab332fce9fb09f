"""`ParallelVectorEnv` compared with Gymnasium's own vector environments, with real processes."""

import contextlib
import functools
import os
import signal

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from physx_core.errors import (
    ActionError,
    ConfigError,
    EnvironmentFailedError,
    UnknownOptionError,
    UsageError,
)
from physx_gym.vector.vector_env import ParallelVectorEnv

pytestmark = pytest.mark.processes

HERE = f"{__file__}:"


class Counter(gymnasium.Env):
    """Counts its steps, with nested spaces and all kinds of infos; ends after some steps."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, length=3, render_mode=None, fails_at=None):
        self.length, self.render_mode, self.fails_at = length, render_mode, fails_at
        self.observation_space = spaces.Dict(
            {
                "count": spaces.Box(0, 1e6, (2,), np.float64),
                "parts": spaces.Tuple((spaces.Discrete(5), spaces.MultiBinary(3))),
            }
        )
        self.action_space = spaces.Dict({"kind": spaces.Discrete(4), "size": spaces.Box(-1, 1)})
        self.count = 0
        self.seen = []

    def observe(self):
        bits = np.array([self.count >> i & 1 for i in range(3)], np.int8)
        return {"count": np.full(2, self.count, float), "parts": (self.count % 5, bits)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = (options or {}).get("start", 0)
        draw = int(self.np_random.integers(1000))
        return self.observe(), {"draw": draw, "options": str(options)}

    def step(self, action):
        assert self.action_space.contains(action)
        self.count += 1
        if self.count == self.fails_at:
            raise RuntimeError("the counter is stuck")
        over = self.count >= self.length
        info = {"kind": int(action["kind"]), "object": object()} if over else {}
        return self.observe(), float(action["size"][0]), over, False, info

    def render(self):
        return np.full((2, 2, 3), self.count, np.uint8)


class Talker(Counter):
    """Changes the names and types of its infos from step to step."""

    TALK = (
        lambda n: {"speed": 0.5 * n, "reward": {"alive": True, "effort": np.float32(n)}},
        lambda n: {"speed": -0.5 * n, "reward": {"alive": False, "effort": np.float32(-n)}},
        lambda n: {"speed": n, "reward": {"alive": True, "effort": np.float32(n)}},
        lambda n: {"speed": n} if n % 2 else {"other": np.int16(n)},
        lambda n: {"speed": 0.25 * n},
        lambda n: {"speed": 0.5 * n},
        lambda n: {"speed": 0.5 * n} if n % 2 else {},
        lambda n: {"speed": 7} if n % 2 else {"speed": 1.5},
        lambda n: {"long": np.arange(100.0), "speed": n},
        lambda n: {"speed": 0.5 if n > 10 else 1, "nothing": {}},
        lambda n: {"speed": np.arange(3.0), "word": "yes"},
        lambda n: {"speed": 3},
        lambda n: {"speed": n},
        lambda n: {},
        lambda n: {"final_obs": 3.0},
    )

    def __init__(self):
        super().__init__(length=99)

    def reset(self, *, seed=None, options=None):
        self.start = seed
        return super().reset(seed=seed, options=options)

    def step(self, action):
        found = self.TALK[self.count % len(self.TALK)](self.start + self.count)
        return *super().step(action)[:4], found


class Broken(Counter):
    """Observes and returns NaN and infinity."""

    def observe(self):
        return {**super().observe(), "count": np.array([np.nan, np.inf])}

    def step(self, action):
        return self.observe(), np.nan, False, False, {"speed": np.nan}


class Unstorable(Counter):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Text(5)


def same(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name, value in one.items():
            same(value, other[name])
    elif isinstance(one, (tuple, list)):
        assert len(one) == len(other)
        for value, others in zip(one, other, strict=True):
            same(value, others)
    elif isinstance(one, np.ndarray) and one.dtype == object:
        same(list(one), list(other))
    elif one is not None or other is not None:
        np.testing.assert_array_equal(one, other)
        assert np.asarray(one).dtype == np.asarray(other).dtype


@pytest.fixture(params=["shared memory", "physx/subprocess"])
def launch(request):
    """Make a vector environment whose processes share memory, or are clients of a launcher."""
    launcher = None if request.param == "shared memory" else request.param
    return functools.partial(ParallelVectorEnv, launcher=launcher)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_it_returns_what_gymnasium_returns(mode, launch, nothing_stays_behind):
    def make():
        return gymnasium.make("CartPole-v1", max_episode_steps=7)

    ours = launch(
        "CartPole-v1",
        3,
        env_kwargs={"max_episode_steps": 7},
        num_processes=2,
        autoreset_mode=mode,
    )
    theirs = SyncVectorEnv([make] * 3, autoreset_mode=mode)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    theirs.action_space.seed(1)
    with ours:
        same(ours.reset(seed=[4, 5, 6]), theirs.reset(seed=[4, 5, 6]))
        for _ in range(20):
            actions = theirs.action_space.sample()
            same(ours.step(actions), theirs.step(actions))
        same(ours.reset(seed=3), theirs.reset(seed=3))


@pytest.mark.parametrize("count", [4, 5])
def test_infos_whose_layout_changes(count, launch, nothing_stays_behind):
    ours, theirs = (
        launch(HERE + "Talker", count, num_processes=2),
        SyncVectorEnv([Talker] * count),
    )
    actions = {"kind": np.zeros(count, int), "size": np.zeros((count, 1), np.float32)}
    with ours:
        same(ours.reset(seed=8), theirs.reset(seed=8))
        for _ in range(2 * len(Talker.TALK)):
            same(ours.step(actions)[4], theirs.step(actions)[4])


def test_nan_and_infinity_are_passed_through(launch, nothing_stays_behind):
    ours, theirs = (
        launch(HERE + "Broken", 2, num_processes=2),
        SyncVectorEnv([Broken] * 2),
    )
    actions = {"kind": np.zeros(2, int), "size": np.zeros((2, 1), np.float32)}
    with ours:
        same(ours.reset(seed=8), theirs.reset(seed=8))
        for _ in range(3):
            same(ours.step(actions), theirs.step(actions))


def test_nested_spaces_infos_calls_and_attributes(caplog, launch, nothing_stays_behind):
    env = launch(HERE + "Counter", 3, env_kwargs={"render_mode": "rgb_array"}, num_processes=3)
    with env:
        observation, infos = env.reset(seed=1, options={"start": 1})
        assert observation["count"].tolist() == [[1.0, 1.0]] * 3
        assert observation["parts"][0].tolist() == [1, 1, 1]
        assert infos["options"].tolist() == ["{'start': 1}"] * 3
        draws = infos["draw"].tolist()
        again = env.reset(seed=[1, 2, 3])[1]["draw"].tolist()
        assert draws == again
        assert len(set(draws)) > 1
        actions = {
            "kind": np.array([0, 1, 2]),
            "size": np.array([[0.5], [-0.5], [1.0]], np.float32),
        }
        kept = env.step(actions)
        env.step(actions)
        observation, rewards, terminated, truncated, infos = env.step(actions)
        assert rewards.tolist() == [0.5, -0.5, 1.0]
        assert terminated.all()
        assert not truncated.any()
        assert infos["kind"].tolist() == [0, 1, 2]
        assert kept[0]["count"].tolist() == [[1.0, 1.0]] * 3  # a copy
        assert [picture[0, 0, 0] for picture in env.render()] == [3, 3, 3]
        env.set_attr("length", [7, 8, 9])
        assert env.get_attr("length") == (7, 8, 9)
        assert env.call("observe")[0]["parts"][0] == 3
        with pytest.raises(UsageError, match=r"call step\(\) directly"):
            env.call("step")
    assert "left out" in caplog.text
    assert "object" in caplog.text
    with pytest.raises(UsageError, match="closed"):
        env.reset()


def test_disabled_autoreset_with_a_mask(launch, nothing_stays_behind):
    env = launch(
        HERE + "Counter", 2, num_processes=1, autoreset_mode="Disabled", env_kwargs={"length": 9}
    )
    with contextlib.closing(env):
        env.reset(seed=0)
        actions = {"kind": np.zeros(2, int), "size": np.zeros((2, 1), np.float32)}
        env.step(actions)
        mask = np.array([False, True])
        observation, _ = env.reset(options={"reset_mask": mask, "start": 4})
        assert observation["count"][:, 0].tolist() == [1.0, 4.0]
        with pytest.raises(ConfigError, match="mask"):
            env.reset(options={"reset_mask": [True]})


def test_mistakes_and_failures_are_reported(launch, nothing_stays_behind):
    with pytest.raises(ConfigError, match=r"CartPole-v7.*CartPole-v1"):
        launch("CartPole-v7", 2)
    with pytest.raises(ConfigError, match="do not have a fixed shape"):
        launch(HERE + "Unstorable", 2)
    with pytest.raises(ConfigError, match="at least 1"):
        launch("CartPole-v1", 0)
    with pytest.raises(ConfigError, match="env_kwargs is 3"):
        launch("CartPole-v1", 1, env_kwargs=3)
    with pytest.raises(UnknownOptionError, match="NextStep"):
        launch("CartPole-v1", 1, autoreset_mode="NextStop")
    env = launch(HERE + "Counter", 2, env_kwargs={"fails_at": 2}, num_processes=2)
    with contextlib.closing(env):
        env.reset()
        with pytest.raises(ActionError, match=r"shape \(3,\) but need \(2,\)"):
            env.step({"kind": np.zeros(3, int), "size": np.zeros((2, 1), np.float32)})
        with pytest.raises(ActionError, match="do not fit"):
            env.step([1, 2])
        with pytest.raises(ConfigError, match="3 seeds"):
            env.reset(seed=[1, 2, 3])
        with pytest.raises(ConfigError, match="whole numbers"):
            env.reset(seed="ab")
        actions = {"kind": np.zeros(2, int), "size": np.zeros((2, 1), np.float32)}
        env.step(actions)
        with pytest.raises(EnvironmentFailedError, match="the counter is stuck"):
            env.step(actions)


def test_it_closes_while_a_forked_process_lives():
    env = ParallelVectorEnv(HERE + "Counter", 2, num_processes=2)
    child = os.fork()
    if not child:  # it inherits all open files
        signal.pause()
    try:
        env.reset()
        env.close()
        assert os.waitpid(child, os.WNOHANG) == (0, 0)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_torchrl_takes_it(mode, nothing_stays_behind):
    libs = pytest.importorskip("torchrl.envs")
    utils = pytest.importorskip("torchrl.envs.utils")
    many = gymnasium.make_vec(
        "physx_gym:physx/Cartpole-v0", 3, num_processes=2, autoreset_mode=mode
    )
    env = libs.GymWrapper(many)
    utils.check_env_specs(env)
    found = env.rollout(60, break_when_any_done=False)
    assert found.shape == (3, 60)
    assert found["next", "done"].any()
    env.close()
