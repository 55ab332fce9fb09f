"""Saved policies, evaluated by a command on any engine."""

import json
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control import PendulumEnv

from physx_core import DataGeneration, DatasetConfig, EnvironmentConfig, NetworkConfig, Training
from physx_core.cli import main
from physx_core.errors import ConfigError, PhysxError
from physx_gym import ComposedEnv, Policy, RobotEnv, plain
from physx_gym.cli import evaluate
from physx_gym.tasks.quantities import JointPositions
from physx_gym.tasks.terminations import OutOfBounds

pytestmark = pytest.mark.processes


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


def test_an_environment_that_exits_does_not_end_the_command_as_a_success(session, capsys):
    class Exits(PendulumEnv):
        def step(self, action):
            sys.exit(0)

    gymnasium.register("Exits-v0", Exits)
    assert main(["evaluate", session, "--env", "Exits-v0"]) == 1
    error = capsys.readouterr().err
    assert "Exits.step() (test_evaluate.py" in error and "not finished" in error


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


# Recordings of episodes that wrappers change ----------------------------------------------------

WRAPPERS = gymnasium.wrappers


class Repeat(gymnasium.Wrapper):
    """Repeats each action for three steps, as trainers' frame skipping does."""

    def step(self, action):
        total = 0.0
        for _ in range(3):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


class Noops(gymnasium.Wrapper):
    """Starts episodes anew after a few steps, as trainers' random starts do."""

    def reset(self, **options):
        self.env.reset(**options)
        for _ in range(4):
            self.env.step(np.zeros(2))
        return self.env.reset(**options)


class Cart(RobotEnv):
    """The reward is the torque of the first motor, so that a recording shows who acted."""

    def __init__(self):
        super().__init__("cartpole", 0.04, simulation_duration_max=1.0)

    def _sample_state(self):
        return self.np_random.uniform(-0.1, 0.1, 2), np.zeros(2)

    def compute_reward(self, terminated, info):
        return float(self.action[0])


def rescaled(env):
    return WRAPPERS.RescaleAction(env, np.float64(-0.1), np.float64(0.1))


WRAPPED = {
    "none": lambda env: env,
    "plain": plain,
    "flattened": WRAPPERS.FlattenObservation,
    "limited": lambda env: WRAPPERS.TimeLimit(env, 7),
    "rescaled": rescaled,
    "limited and rescaled": lambda env: WRAPPERS.TimeLimit(rescaled(env), 7),
    "stacked": lambda env: WRAPPERS.FrameStackObservation(WRAPPERS.FlattenObservation(env), 3),
    "delayed": lambda env: WRAPPERS.DelayObservation(WRAPPERS.FlattenObservation(env), 2),
    "sticky": lambda env: WRAPPERS.StickyAction(env, 0.5),
    "counted": WRAPPERS.RecordEpisodeStatistics,
    "repeated": Repeat,
    "repeated and limited": lambda env: WRAPPERS.TimeLimit(Repeat(env), 4),
    "started anew": Noops,
    "terminating": lambda env: ComposedEnv(
        env, terminations=OutOfBounds(JointPositions(), -0.11, 0.11, "fell")
    ),
    "terminating in training": lambda env: ComposedEnv(
        env,
        terminations=OutOfBounds(JointPositions(), -0.11, 0.11, "fell", training_only=True),
    ),
}


class Steering:
    """A policy that depends on all that it sees; it keeps what it did."""

    def __init__(self, env):
        self.space = env.action_space

    def act(self, observation):
        seen = np.concatenate([np.ravel(x) for x in _leaves(observation)])
        share = np.full(self.space.shape, 0.5 + 0.5 * np.sin(100 * seen.sum()))
        return self.space.low + share * (self.space.high - self.space.low)


def _leaves(tree):
    return (
        [leaf for x in tree.values() for leaf in _leaves(x)] if isinstance(tree, dict) else [tree]
    )


@pytest.mark.parametrize("name", WRAPPED)
def test_the_recorded_episode_is_the_evaluated_one(name):
    base = Cart()
    env = WRAPPED[name](base)
    act = Steering(env).act
    commands = []
    compute = base.compute_command

    def listen(action, command):
        compute(action, command)
        commands.append(command.copy())

    figures, recording = evaluate.evaluate_recorded(env, act, 3)
    base.eval()
    base.compute_command = listen
    assert evaluate.evaluate(env, act, [3]) == [figures]
    steps = int(base.num_steps)
    columns = recording["variables"]
    rewards = columns["reward.step"][1:]
    assert len(rewards) == steps
    assert rewards.sum() == pytest.approx(figures["reward"])
    told = np.transpose([columns["action.slider"], columns["action.hinge"]])
    np.testing.assert_array_equal(told[:-1], np.array(commands)[-steps:])
    repeats = 3 if "repeated" in name else 1
    assert figures["length"] == -(-steps // repeats)
    assert (figures["length"] == 7) == ("limited" in name and repeats == 1)
    env.close()


def test_an_environment_without_a_robot_is_not_recorded():
    with pytest.raises(ConfigError, match="is not a RobotEnv"):
        evaluate.evaluate_recorded(Walk(), lambda seen: seen[:1], 0)


SWING = """
import gymnasium, numpy as np
from physx_gym import RobotEnv

class Swing(RobotEnv):
    def __init__(self, **options):
        super().__init__("cartpole", 0.04, simulation_duration_max=1.0, **options)
    def compute_reward(self, terminated, info):
        return float(self.training)

def make(**options):
    return gymnasium.wrappers.TimeLimit(gymnasium.wrappers.FlattenObservation(Swing(**options)), 7)
"""


def test_the_command_records_through_wrappers(tmp_path, capsys, monkeypatch):
    pytest.importorskip("physx_rerun")
    (tmp_path / "swing.py").write_text(SWING)
    monkeypatch.chdir(tmp_path)
    options = {"session_dir": str(tmp_path), "quiet": True}
    environment = EnvironmentConfig("gym/swing.py:make", seed=0, as_tcp_ip_client=False)
    DataGeneration(environment, session_name="data", batch_nb=1, batch_size=20, **options).execute()
    kwargs = {"net_fields": "observation", "opt_fields": "action"}
    network = NetworkConfig("toy/linear", network_kwargs=kwargs)
    Training(
        network, DatasetConfig("data"), session_name="run", epoch_nb=1, batch_size=20, **options
    ).execute()
    words = ["run", "--env", "swing.py:make", "--episodes", "2", "--json"]
    evaluate.run(words)
    alone = capsys.readouterr().out
    evaluate.run([*words, "--replay", "swing.rrd"])
    recorded = capsys.readouterr().out
    assert recorded.startswith(alone) and "recording: swing.rrd" in recorded
    assert (tmp_path / "swing.rrd").stat().st_size > 1000
    figures = [(each["length"], each["reward"]) for each in json.loads(alone)["episodes"]]
    assert figures == [(7, 0.0), (7, 0.0)]  # in evaluation mode, recorded or not
