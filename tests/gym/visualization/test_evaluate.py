"""Evaluating a policy over one episode."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from physx_core.errors import ConfigError
from physx_gym import RobotEnv, read_log
from physx_sim.errors import SimulationError

pytestmark = pytest.mark.processes


class Balance(RobotEnv):
    """A reward of 1 a step, until the pole is down."""

    def compute_reward(self, terminated, info):
        info["angle"] = float(self.robot_state.q[1])
        return 1.0

    def has_terminated(self, info):
        return abs(self.robot_state.q[1]) > 0.5, False


class Policy:
    """Keeps what it is asked with."""

    def __init__(self, env, fail=None):
        self.env, self.fail, self.asked = env, fail, []

    def __call__(self, observation, action, reward, terminated, truncated, info):
        self.asked.append((observation, action, reward, terminated, truncated, info))
        if self.fail and len(self.asked) == 4:
            self.fail()
        return np.full(2, 0.1 * len(self.asked))


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture
def env():
    env = Balance("cartpole", 0.02)
    yield env
    env.close()


def test_rewards_and_information_of_all_steps(env, backend):
    env = Balance("cartpole", 0.02, backend=backend)
    policy = Policy(env)
    rewards, infos = env.evaluate(policy, seed=1)
    assert rewards == [1.0] * len(rewards)
    assert len(infos) == len(rewards) + 1
    assert len(policy.asked) == len(infos)
    assert "log_path" in infos[0]
    assert [asked[5] for asked in policy.asked] == infos
    assert abs(infos[-1]["angle"]) > 0.5 >= abs(infos[-2]["angle"])


def test_the_policy_gets_the_previous_step(env):
    policy = Policy(env)
    rewards, _ = env.evaluate(policy, seed=1)
    first, second, *_, last = policy.asked
    assert first[1:5] == (None, None, False, False)
    np.testing.assert_array_equal(second[1], [0.1, 0.1])
    assert second[2] == 1.0
    assert last[3:5] == (True, False)
    times = [float(asked[0]["t"]) for asked in policy.asked]
    np.testing.assert_allclose(times, 0.02 * np.arange(len(rewards) + 1))


@pytest.mark.parametrize(("horizon", "steps"), [(0.1, 5), (0.099, 5), (0.101, 6), (0.02, 1)])
def test_a_horizon_ends_it(env, horizon, steps):
    policy = Policy(env)
    rewards, infos = env.evaluate(policy, seed=0, horizon=horizon)
    assert (len(rewards), len(infos), len(policy.asked)) == (steps, steps + 1, steps + 1)
    assert policy.asked[-1][3:5] == (False, False)


def test_an_invalid_horizon(env):
    with pytest.raises(ConfigError, match="horizon"):
        env.evaluate(Policy(env), horizon=0.0)


def test_it_is_recorded_and_the_mode_is_restored(env):
    env.reset(seed=0)
    _, infos = env.evaluate(lambda *_: env.action, seed=2, horizon=0.1)
    assert env.training
    assert not env.is_simulation_running
    log = read_log(infos[0]["log_path"])
    assert len(log.time) == 6
    assert log.constants["seed"] == 2
    assert len(env.log_data["variables"]["time"]) == 6
    env.eval()
    env.evaluate(lambda *_: env.action, horizon=0.1)
    assert not env.training


def test_the_same_seed_gives_the_same_episode(env):
    found = [env.evaluate(Policy(env), seed=4, horizon=0.2)[1][-1] for _ in range(2)]
    assert found[0] == found[1]


def test_ctrl_c_ends_it_early(env):
    policy = Policy(env, lambda: os.kill(os.getpid(), signal.SIGINT))
    rewards, infos = env.evaluate(policy, seed=0)
    assert (len(rewards), len(infos)) == (3, 4)
    assert env.training
    assert len(env.log_data["variables"]["time"]) == 4


def test_an_error_in_the_policy_propagates_and_the_mode_is_restored(env):
    def fail():
        raise SimulationError("no idea")

    with pytest.raises(SimulationError, match="no idea"):
        env.evaluate(Policy(env, fail), seed=0)
    assert env.training
    assert not env.is_simulation_running


def test_statistics_are_printed_on_request(env, capsys):
    env.evaluate(Policy(env), seed=0, horizon=0.1)
    assert capsys.readouterr().out == "steps: 5 (0.1 s), total reward: 5\n"
    env.evaluate(Policy(env), seed=0, horizon=0.1, enable_stats=False)
    assert capsys.readouterr().out == ""


def test_a_replay_on_request(env, tmp_path):
    path = tmp_path / "a.rrd"
    env.evaluate(Policy(env), horizon=0.1, enable_replay=True, path=path, frame_rate=50)
    assert path.read_bytes()[:3] == b"RRF"


def test_a_replay_that_fails_is_a_warning(env):
    with pytest.warns(UserWarning, match="cannot be replayed: .*there is no display"):
        rewards, _ = env.evaluate(Policy(env), horizon=0.1, enable_replay=True)
    assert len(rewards) == 5
