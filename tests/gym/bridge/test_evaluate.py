"""Saved policies, evaluated by a command on any engine."""

import json

import gymnasium
import numpy as np
import pytest

from physx_core import DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig, Training
from physx_core.errors import ConfigError, PhysxError
from physx_gym import Policy
from physx_gym.cli import evaluate


class Walk(gymnasium.Env):
    """Walks as fast as it is told, for three steps; succeeds if it was told to walk forward."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)

    def __init__(self, factor=1.0):
        self.factor = factor

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 3
        return self._observe(), {}

    def _observe(self):
        self.seen = self.np_random.uniform(-1, 1, 2)
        return self.seen

    def step(self, action):
        self.left -= 1
        speed = self.factor * float(action[0])
        info = {"x_velocity": speed, "is_success": speed > 0}
        return self._observe(), 2 * speed, False, self.left == 0, info


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A policy that is trained a little, so that it is a policy."""
    place = str(tmp_path_factory.mktemp("policy"))
    environment = EnvironmentConfig("gym/Pendulum-v1", seed=0, as_tcp_ip_client=False)
    options = {"session_dir": place, "quiet": True}
    run = DataGeneration(environment, session_name="data", batch_nb=1, batch_size=50, **options)
    run.execute()
    kwargs = {"net_fields": "observation", "opt_fields": "action"}
    network = NetworkConfig("toy/linear", network_kwargs=kwargs)
    data = DatasetConfig(f"{place}/data")
    Training(network, data, session_name="run", epoch_nb=1, batch_size=50, **options).execute()
    return f"{place}/run"


def test_a_policy_is_evaluated_as_a_table_and_as_json(session, capsys):
    words = [session, "--env", "Pendulum-v1", "--episodes", "2", "--seed", "3"]
    evaluate.run(words)
    table = capsys.readouterr().out
    assert "Pendulum-v1: 2 episodes, seeds 3 to 4" in table
    evaluate.run([*words, "--json", "--env-kwargs", "g=0.0"])
    found = json.loads(capsys.readouterr().out)
    assert [episode["seed"] for episode in found["episodes"]] == [3, 4]
    assert found["summary"]["length"] == {"mean": 200, "std": 0, "min": 200, "max": 200}
    env = gymnasium.make("Pendulum-v1", g=0.0)
    policy, (seen, _), total = Policy(session, env), env.reset(seed=4), 0.0
    for _ in range(200):
        seen, reward, *_ = env.step(policy(seen))
        total += reward
    assert found["episodes"][1]["reward"] == pytest.approx(total)


def test_speeds_and_successes_are_those_of_the_information():
    found = evaluate.evaluate(Walk(0.5), lambda seen: np.abs(seen[:1]), range(2))
    assert [each["success"] for each in found] == [1.0, 1.0]
    for each in found:
        assert each["speed"] == pytest.approx(each["reward"] / 6)
    table = evaluate.summary(found)
    speeds = [each["speed"] for each in found]
    assert table["speed"]["mean"] == pytest.approx(np.mean(speeds))
    assert (table["speed"]["min"], table["speed"]["max"]) == (min(speeds), max(speeds))
    assert "seed" not in table


def test_what_cannot_be_evaluated_says_why(session, tmp_path):
    with pytest.raises(ConfigError, match="--episodes is 0"):
        evaluate.run([session, "--env", "Pendulum-v1", "--episodes", "0"])
    with pytest.raises(PhysxError, match="no network in"):
        evaluate.run([str(tmp_path), "--env", "Pendulum-v1"])
    words = [session, "--env", "Pendulum-v1", "--episodes", "1"]
    with pytest.raises(ConfigError, match="is not a RobotEnv"):
        evaluate.run([*words, "--replay", str(tmp_path / "walk.rrd")])
    with pytest.raises(ConfigError, match="Pendulum-v1"):
        evaluate.run([session, "--env", "Pendulum-v9"])
