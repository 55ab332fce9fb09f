"""A vector environment with a single environment, which runs in this process."""

import os
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from physx_core.errors import ConfigError, EnvironmentFailedError, UsageError
from physx_gym import ParallelVectorEnv

pytestmark = pytest.mark.processes

HERE = f"{__file__}:"


class Counter(gymnasium.Env):
    """Counts its steps, says in which process, and fails as it is told."""

    def __init__(self, length=3, fails_in=""):
        self.observation_space = spaces.Dict({"count": spaces.Box(0, 99, (2,), np.float64)})
        self.action_space = spaces.Discrete(3)
        self.length, self.fails_in, self.count = length, fails_in, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.fail("reset")
        self.count = (options or {}).get("start", 0)
        return {"count": np.full(2, self.count, float)}, {"draw": int(self.np_random.integers(99))}

    def step(self, action):
        self.fail("step")
        self.count += 1
        info = {"pid": os.getpid(), "odd": {"count": self.count}} if self.count % 2 else {}
        over = self.count >= self.length
        return {"count": np.full(2, self.count, float)}, float(action), over, False, info

    def fail(self, method):
        if self.fails_in == method == "step":
            sys.exit(0)
        elif self.fails_in == method:
            raise OSError("no more")

    def close(self):
        self.fail("close")

    def pid(self):
        return os.getpid()


def same(one, other):
    assert type(one) is type(other) or np.isscalar(one)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for name in one:
            same(one[name], other[name])
    elif isinstance(one, tuple):
        for mine, theirs in zip(one, other, strict=True):
            same(mine, theirs)
    elif isinstance(one, np.ndarray) and one.dtype == object:
        same(tuple(one), tuple(other))
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_it_returns_what_gymnasium_returns_without_a_process(mode, nothing_stays_behind):
    theirs = SyncVectorEnv([Counter], autoreset_mode=mode)
    with ParallelVectorEnv(Counter, 1, autoreset_mode=mode) as ours:
        assert ours.call("pid") == (os.getpid(),)
        same(ours.reset(seed=5, options={"start": 1}), theirs.reset(seed=5, options={"start": 1}))
        for number in range(10):
            mine, others = (env.step(np.array([number % 3])) for env in (ours, theirs))
            same(mine, others)
            if mode is AutoresetMode.DISABLED and mine[2][0]:
                masks = [{"reset_mask": np.array([True])} for _ in range(2)]
                same(ours.reset(options=masks[0]), theirs.reset(options=masks[1]))


def test_results_do_not_change_later(nothing_stays_behind):
    with ParallelVectorEnv(Counter, 1) as vector:
        first, _ = vector.reset(seed=0)
        vector.step(np.array([0]))
        np.testing.assert_array_equal(first["count"], np.zeros((1, 2)))


def test_send_and_recv_methods_and_attributes(nothing_stays_behind):
    with ParallelVectorEnv(f"{HERE}Counter", 1, env_kwargs={"length": 9}) as vector:
        vector.async_reset(seed=0)
        assert vector.recv()[-1]["env_id"] == [0]
        vector.send(np.array([2]), [0])
        with pytest.raises(UsageError, match="still pending"):
            vector.send(np.array([2]))
        assert vector.recv()[1] == [2.0]
        vector.set_attr("length", 2)
        assert vector.get_attr("length") == (2,)
        assert vector.step(np.array([1]))[2] == [True]
        with pytest.raises(UsageError, match="cannot be sent"):
            vector.get_attr("np_random")


@pytest.mark.parametrize(
    ("method", "text"),
    [
        ("reset", r"Instance 1 raised in reset\(\): OSError: no more"),
        ("step", r"Instance 1 raised in step\(\): SystemExit: 0"),
        ("close", r"Instance 1 raised in close\(\): OSError: no more"),
    ],
)
def test_errors_are_those_of_a_process(method, text, nothing_stays_behind):
    vector = ParallelVectorEnv(Counter, 1)
    with vector, pytest.raises(EnvironmentFailedError, match=text):
        vector.set_attr("fails_in", method)
        vector.reset()
        vector.step(np.array([0]))
        vector.close()
    if method != "close":
        with pytest.raises(UsageError, match="ended with an error"):
            vector.reset()


def test_an_interrupted_step_closes_the_environment(nothing_stays_behind, monkeypatch):
    closed = []
    monkeypatch.setattr(Counter, "close", lambda self: closed.append(self))
    monkeypatch.setattr(Counter, "step", interrupt)
    vector = ParallelVectorEnv(Counter, 1)
    vector.reset()
    before = len(closed)
    with pytest.raises(KeyboardInterrupt):
        vector.step(np.array([0]))
    assert len(closed) == before + 1


def interrupt(self, action):
    raise KeyboardInterrupt


def test_a_launcher_has_its_process_all_the_same(nothing_stays_behind):
    with ParallelVectorEnv(f"{HERE}Counter", 1, launcher="physx/subprocess") as vector:
        assert vector.call("pid") != (os.getpid(),)


@pytest.mark.parametrize(
    "options",
    [{"retries": 20}, {"launcher_kwargs": {"affinity": True}}, {"ip_address": "0.0.0.0"}],
)
@pytest.mark.parametrize("count", [1, 2])
def test_options_of_a_launcher_are_refused_without_one(options, count):
    with pytest.raises(ConfigError, match=rf"{next(iter(options))} would have no effect .* launch"):
        ParallelVectorEnv(Counter, count, **options)
