"""Gymnasium environments as physx environments, and networks as policies."""

import gymnasium
import numpy as np
import pytest

from physx_core import (
    DataGeneration,
    Dataset,
    DatasetConfig,
    EnvironmentConfig,
    NetworkConfig,
    Prediction,
    Training,
)
from physx_core.errors import ConfigError, UsageError
from physx_gym.bridge.policy import Policy, action_arrays
from physx_gym.spaces import SpaceFields

pytestmark = pytest.mark.processes


def lean(observation):
    """Push the cart in the direction in which the pole falls."""
    return int(observation[2] + 0.5 * observation[3] > 0)


def generate(tmp_path, environment, name="data", batch_nb=4, batch_size=50, **options):
    run = DataGeneration(
        EnvironmentConfig(environment, seed=3, **options),
        session_dir=str(tmp_path),
        session_name=name,
        batch_nb=batch_nb,
        batch_size=batch_size,
    )
    run.execute()
    return Dataset.open(tmp_path / name)


def test_transitions_are_stored_with_episodes_and_both_ends(tmp_path):
    options = {"env_kwargs": {"max_episode_steps": 12}, "num_clients": 2}
    with generate(tmp_path, "gym/CartPole-v1", **options) as dataset:
        rows = {name: dataset["training"][name][:] for name in dataset.fields("training")}
        episodes = dataset.episodes("training")
    assert rows["observation"].shape == rows["next_observation"].shape == (200, 4)
    assert rows["observation"].dtype == np.float32
    assert rows["action"].dtype == np.int64
    assert rows["terminated"].any()
    assert rows["truncated"].any()
    whole = [e for e in episodes if rows["terminated"][e.rows[-1]] or rows["truncated"][e.rows[-1]]]
    assert len(whole) > 5
    for episode in episodes:
        numbers = np.array(episode.rows)
        before, after = rows["next_observation"][numbers[:-1]], rows["observation"][numbers[1:]]
        np.testing.assert_array_equal(before, after)
        assert not (rows["terminated"] | rows["truncated"])[numbers[:-1]].any()
        assert len(numbers) <= 12


def test_independent_episodes_are_those_that_reset_begins_with_a_seed(tmp_path):
    found = []
    for instances in (1, 2):
        options = {"num_clients": instances}
        with generate(tmp_path, "gym/CartPole-v1", f"run{instances}", **options) as dataset:
            rows = {name: dataset["training"][name][:] for name in dataset.fields("training")}
        found.append({name: values.tolist() for name, values in rows.items()})
        first = rows["observation"][np.unique(rows["episode"], return_index=True)[1]]
        assert len(np.unique(first, axis=0)) == len(first) >= 3
    assert found[0] == found[1]


def test_rows_are_those_of_gymnasium_and_the_same_with_clients(tmp_path):
    with generate(tmp_path, "gym/CartPole-v1", "here", as_tcp_ip_client=False) as dataset:
        here = {name: dataset["training"][name][:] for name in dataset.fields("training")}
    with generate(tmp_path, "gym/CartPole-v1", "there") as dataset:
        there = {name: dataset["training"][name][:] for name in dataset.fields("training")}
    for name, values in here.items():
        np.testing.assert_array_equal(values, there[name])
    env = gymnasium.make("CartPole-v1")
    env.reset()
    first = here["episode"] == 0
    env.unwrapped.state = here["observation"][0].astype(np.float64)
    for row in np.flatnonzero(first)[:3]:
        observation, reward, *_ = env.step(int(here["action"][row]))
        np.testing.assert_allclose(observation, here["next_observation"][row], atol=1e-6)
        assert reward == here["reward"][row]


def test_a_network_learns_from_them_and_acts(tmp_path):
    generate(
        tmp_path,
        "gym/MountainCarContinuous-v0",
        env_kwargs={"policy": f"{__file__}:push_along"},
        as_tcp_ip_client=False,
        batch_nb=8,
    ).close()
    network = NetworkConfig(
        "toy/linear",
        network_kwargs={
            "net_fields": "observation",
            "opt_fields": "action",
        },
    )
    Training(
        network,
        DatasetConfig(existing_dir=str(tmp_path / "data")),
        session_dir=str(tmp_path),
        session_name="learned",
        epoch_nb=30,
        batch_size=50,
        seed=0,
    ).execute()
    env = gymnasium.make("MountainCarContinuous-v0")
    policy = Policy(tmp_path / "learned", env)
    observation, _ = env.reset(seed=0)
    action = policy(observation)
    assert env.action_space.contains(action)
    assert policy.act(observation, None, None, False, False, {}) == pytest.approx(action)
    many = gymnasium.make_vec("MountainCarContinuous-v0", 3)
    actions = Policy(tmp_path / "learned", many)(many.reset(seed=0)[0])
    assert many.action_space.contains(actions)
    np.testing.assert_allclose(actions[0], action, rtol=1e-5)
    Prediction(
        NetworkConfig(),
        EnvironmentConfig("gym/MountainCarContinuous-v0", env_kwargs={"policy": "network"}, seed=1),
        session_dir=str(tmp_path),
        session_name="learned",
        step_nb=5,
        record=True,
    ).execute()
    with Dataset.open(tmp_path / "learned") as dataset:
        taken = dataset["prediction"]["action"][:]
        seen = dataset["prediction"]["observation"][:]
    for observation, action in zip(seen, taken, strict=True):
        np.testing.assert_allclose(policy(observation), action, rtol=1e-5)


def push_along(observation):
    """Push where the car moves, by as much as it moves."""
    return np.array([0.5 + 10 * observation[1]], np.float32)


def test_mistakes_are_reported(tmp_path):
    with pytest.raises(ConfigError, match="CartPole-v7"):
        generate(
            tmp_path,
            "physx_gym.bridge.gym_environment:GymEnvironment",
            env_kwargs={"id": "CartPole-v7"},
            as_tcp_ip_client=False,
        )
    with pytest.raises(ConfigError, match='"random", "network"'):
        generate(
            tmp_path,
            "gym/CartPole-v1",
            env_kwargs={"policy": "clever"},
            as_tcp_ip_client=False,
        )
    with pytest.raises(UsageError, match="this run has none"):
        generate(
            tmp_path,
            "gym/CartPole-v1",
            env_kwargs={"policy": "network"},
            as_tcp_ip_client=False,
        )


SPACES = gymnasium.spaces


@pytest.mark.parametrize(
    ("space", "outputs", "wanted"),
    [
        (SPACES.Box(-1, 1, (2,)), [[0.5, 7.0]], [[0.5, 1.0]]),
        (SPACES.Box(0, 9, (1,), np.int32), [[3.6]], [[4]]),
        (SPACES.Discrete(3, start=2), [[0.1, 0.2, 0.7]], [4]),
        (SPACES.Discrete(3), [[1.6]], [2]),
        (SPACES.Discrete(3), [[-4.0]], [0]),
        (SPACES.MultiDiscrete([2, 3]), [[0.9, 0.1, 0.0, 0.2, 0.1]], [[0, 1]]),
        (SPACES.MultiDiscrete([2, 3]), [[0.7, 5.0]], [[1, 2]]),
        (SPACES.MultiBinary(3), [[0.2, 0.6, 0.5]], [[0, 1, 0]]),
    ],
)
def test_actions_from_predictions(space, outputs, wanted):
    actions = SpaceFields(space, "action")
    found = action_arrays(actions, {"out": np.array(outputs)})["action"]
    assert found.tolist() == wanted
    assert space.contains(actions.value({"action": found[0]}))


def test_a_wrong_number_of_outputs_is_reported():
    actions = SpaceFields(SPACES.Box(-1, 1, (2,)), "action")
    with pytest.raises(UsageError, match=r"predicts 3 values for the action"):
        action_arrays(actions, {"out": np.zeros((1, 3))})
    two = SpaceFields(SPACES.Tuple((SPACES.Discrete(2), SPACES.Discrete(2))), "action")
    with pytest.raises(UsageError, match="name it in pred_fields"):
        action_arrays(two, {"out": np.zeros((1, 2))})
