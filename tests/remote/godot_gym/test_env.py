"""The clients of godot-gym: environments of Gymnasium, and what they say when things go wrong."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from physx_core.errors import UsageError
from physx_remote import serve
from physx_remote.errors import RemoteError
from physx_remote.serving.spaces import to_json

pytestmark = pytest.mark.filterwarnings("ignore:.*Box observation space:UserWarning")


class EverySpace(gymnasium.Env):
    """Says what its actions were; its spaces have parts of every kind."""

    observation_space = action_space = spaces.Dict(
        {
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
    )

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


# Environments of Gymnasium ----------------------------------------------------------------------


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1", "Blackjack-v1"])
def test_the_checker_of_gymnasium(drive, name):
    check_env(drive(f"gym/{name}"), skip_render_check=True)


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "Acrobot-v1"])
def test_the_same_trajectory_as_in_process(drive, same, name):
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


def test_every_kind_of_space_and_value(drive, same):
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


@pytest.mark.parametrize(
    ("part", "value", "said"),
    [
        ("box", [[0, 0, 0], [0, np.nan, 0]], r'The action\["box"\]\[1\]\[1\] is nan'),
        ("bounds", [0, np.inf], r'The action\["bounds"\]\[1\] is inf'),
        ("bounds", [1e300, 0], r'The action\["bounds"\]\[0\] is inf'),
        ("single", -np.inf, r'The action\["single"\] is -inf'),
        ("whole", [0, 10, 0], r'The action\["whole"\]\[1\] is 10'),
        ("whole", [0, 10**30, 0], r'The action\["whole"\] must be in'),
        ("one", 3, r'The action\["one"\] is 3, which is not an element of Discrete'),
        ("one", -3, r'The action\["one"\] is -3'),
        ("bits", [[0, 1], [1, 2]], r'The action\["bits"\]\[1\]\[1\] is 2'),
        ("several", [0, 4], r'The action\["several"\]\[1\] is 4'),
        ("pair", [2, {"x y": 0}], r'The action\["pair"\]\[0\] is 2'),
        ("pair", [1, {"x y": 3}], r'The action\["pair"\]\[1\]\["x y"\] is 3'),
    ],
)
def test_an_action_that_the_space_does_not_hold_is_refused(drive, caplog, part, value, said):
    env = drive(EverySpace)
    env.reset(seed=1)
    action = to_json(env.action_space, env.action_space.sample())
    with pytest.raises(RemoteError, match=said):
        env.client.step({**action, part: value}, env.requested_observation)
    assert "Traceback" not in caplog.text
    assert env.ended_of(env.client.step(action, env.requested_observation)) == (False, False)


def test_how_far_a_continuous_action_goes_is_for_the_environment_to_say(drive, same):
    here, there = gymnasium.make("Pendulum-v1"), drive("gym/Pendulum-v1")
    here.reset(seed=1)
    there.reset(seed=1)
    action = np.array([50.0], np.float32)  # Pendulum clips it
    assert same(here.step(action)[0], there.step(action)[0])


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
