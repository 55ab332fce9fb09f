"""stable-baselines3 on vector environments of Gymnasium, and its policies as those of physx."""

import logging

import gymnasium
import hypothesis
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import stateful
from hypothesis import strategies as st
from sizes import trials

from physx_core.errors import ConfigError, UsageError
from physx_gym import ParallelVectorEnv, Policy

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")

from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from physx_gym.stable_baselines3 import GymnasiumVecEnv, save_policy

pytestmark = pytest.mark.processes

COUNT = 3
WALK = f"{__file__}:Walk"
SAME_STEP = AutoresetMode.SAME_STEP


class Walk(gymnasium.Env):
    """A random walk that ends or is cut after some steps, and tells where it is now and then."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, render_mode="rgb_array"):
        self.render_mode, self.length, self.seen = render_mode, 3, None

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count, self.place = 0, (options or {}).get("place", 0.0) + self.np_random.normal()
        return self.observe(), {"begun": self.place}

    def observe(self):
        return np.array([self.place, self.count], float)

    def step(self, action):
        self.count += 1
        self.place += float(action[0]) + self.np_random.normal()
        told = {"place": self.place, "parts": {"far": abs(self.place) > 1}}
        info, last = told if self.count > 1 else {}, self.count >= self.length
        return self.observe(), self.place, last and self.place > 0, last, info

    def render(self):
        return np.full((2, 2, 3), int(self.count), np.uint8)

    def shifted(self, by, scale=1):
        return scale * (self.place + by)


class Histories(stateful.RuleBasedStateMachine):
    """The same calls of stable-baselines3's own vector environment and of one of Gymnasium."""

    vector = None

    def __init__(self):
        super().__init__()
        self.ours, self.theirs = GymnasiumVecEnv(self.vector), DummyVecEnv([Walk] * COUNT)
        for each in (self.ours, self.theirs):
            each.set_attr("length", 3)

    @stateful.initialize(seed=st.integers(0, 9))
    def begin(self, seed):
        self.seed(seed)
        self.reset()

    @stateful.rule(seed=st.integers(0, 9))
    def seed(self, seed):
        assert self.ours.seed(seed) == self.theirs.seed(seed)

    @stateful.rule(place=st.floats(-5, 5))
    def set_options(self, place):
        for each in (self.ours, self.theirs):
            each.set_options({"place": place})

    @stateful.rule()
    def reset(self):
        np.testing.assert_array_equal(self.ours.reset(), self.theirs.reset())
        assert self.ours.reset_infos == self.theirs.reset_infos

    @stateful.rule(actions=st.lists(st.floats(-1, 1, width=32), min_size=COUNT, max_size=COUNT))
    def step(self, actions):
        actions = np.array(actions, np.float32)[:, None]
        found, wanted = self.ours.step(actions), self.theirs.step(actions)
        for one, other in zip(found[:3], wanted[:3], strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
        for one, other in zip(found[3], wanted[3], strict=True):
            np.testing.assert_equal(one, other)
        assert self.ours.reset_infos == self.theirs.reset_infos

    @stateful.rule(
        length=st.integers(1, 4),
        chosen=st.none() | st.integers(0, COUNT - 1) | st.lists(st.integers(0, COUNT - 1)),
    )
    def set_length(self, length, chosen):
        for each in (self.ours, self.theirs):
            each.set_attr("length", length, chosen)
        assert self.ours.get_attr("length", chosen) == self.theirs.get_attr("length", chosen)
        assert self.ours.get_attr("length") == self.theirs.get_attr("length")

    @stateful.rule(by=st.floats(-1, 1))
    def call(self, by):
        found = [each.env_method("shifted", by, scale=2) for each in (self.ours, self.theirs)]
        assert found[0] == found[1]

    @stateful.rule(name=st.sampled_from(["length", "place", "none"]))
    def has_attribute(self, name):
        assert self.ours.has_attr(name) == self.theirs.has_attr(name)

    @stateful.rule()
    def render(self):
        np.testing.assert_array_equal(
            self.ours.render("rgb_array"), self.theirs.render("rgb_array")
        )


@pytest.mark.parametrize("kind", [pytest.param("Gymnasium", marks=pytest.mark.faults), "physx"])
def test_any_history_is_that_of_stable_baselines3(kind):
    if kind == "physx":
        vector = ParallelVectorEnv(WALK, COUNT, num_processes=2, autoreset_mode="SameStep")
    else:
        vector = SyncVectorEnv([Walk] * COUNT, autoreset_mode=SAME_STEP)
    machine = type(kind, (Histories,), {"vector": vector})
    sizes = {"max_examples": trials(20, 8), "stateful_step_count": 15}
    settings = hypothesis.settings(deadline=None, **sizes)
    try:
        stateful.run_state_machine_as_test(machine, settings=settings)
    finally:
        vector.close()


def test_monitored_episodes_and_what_is_refused():
    envs = GymnasiumVecEnv(SyncVectorEnv([Walk] * COUNT, autoreset_mode=SAME_STEP, copy=False))
    assert envs.env_is_wrapped(Monitor) == [False] * COUNT
    envs.set_options([{"place": 1.0}, {}, {}])
    with pytest.raises(UsageError, match="with the same options"):
        envs.reset()
    envs.set_options()
    first = envs.reset()
    kept = first.copy()
    with pytest.raises(UsageError, match=r"shifted\(\) was requested for only some"):
        envs.env_method("shifted", 1.0, indices=[0, 1, 0])
    envs.step(np.zeros((COUNT, 1), np.float32))
    np.testing.assert_array_equal(first, kept)  # a buffer of its own, copy=False or not
    monitored = VecMonitor(envs)
    monitored.reset()
    for _ in range(3):
        infos = monitored.step(np.zeros((COUNT, 1), np.float32))[3]
    assert [info["episode"]["l"] for info in infos] == [3] * COUNT
    with envs:
        assert not envs.vector.closed
    assert envs.vector.closed
    envs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED])
def test_another_autoreset_mode_is_refused(mode):
    with pytest.raises(ConfigError, match=f"autoreset_mode is '{mode.value}'.*SameStep"):
        GymnasiumVecEnv(SyncVectorEnv([Walk], autoreset_mode=mode))


# Policies ---------------------------------------------------------------------------------------

SMALL = {"seed": 0, "device": "cpu"}


class Choice(Walk):
    """A walk whose actions are parts of several choices."""

    action_space = gymnasium.spaces.MultiDiscrete([2, 3])


class Map(Walk):
    """A walk that is seen as a matrix of single precision."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2, 3), np.float32)

    def observe(self):
        return np.full((2, 3), self.place, np.float32)


@pytest.mark.parametrize(
    ("algorithm", "made", "net_arch"),
    [
        (PPO, lambda: gymnasium.make("Pendulum-v1"), [8, 8]),
        (A2C, lambda: gymnasium.make("CartPole-v1"), {"pi": [8], "vf": [4]}),
        (PPO, Choice, []),
        (PPO, Map, [4]),
    ],
)
def test_a_saved_policy_acts_as_the_model(algorithm, made, net_arch, tmp_path):
    many = VecNormalize(DummyVecEnv([made] * 2), clip_obs=np.inf)
    model = algorithm("MlpPolicy", many, policy_kwargs={"net_arch": net_arch}, n_steps=32, **SMALL)
    model.learn(64)
    assert save_policy(model, tmp_path / "policy") == tmp_path / "policy/network/network_0"
    env = made()
    policy = Policy(tmp_path / "policy", env)
    env.observation_space.seed(0)
    for _ in range(20):
        seen = env.observation_space.sample()
        wanted, _ = model.predict(many.normalize_obs(seen), deterministic=True)
        np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)


def test_the_last_policy_that_was_saved_is_read(tmp_path):
    env = gymnasium.make("Pendulum-v1")
    for seed in range(2):
        model = PPO("MlpPolicy", env, seed=seed, device="cpu")
        assert save_policy(model, tmp_path).name == f"network_{seed}"
    seen = np.array([1.0, 0.0, 0.5], np.float32)
    wanted, _ = model.predict(seen, deterministic=True)
    np.testing.assert_allclose(Policy(tmp_path, env)(seen), wanted, atol=1e-6)


def test_clipped_observations_are_a_warning(tmp_path, caplog):
    many = VecNormalize(DummyVecEnv([Walk]))
    with caplog.at_level(logging.WARNING, "physx"):
        save_policy(PPO("MlpPolicy", many, **SMALL), tmp_path)
    assert "clips observations at 10 standard deviations" in caplog.text


class Binary(Walk):
    """A walk with an action that is no choice of one."""

    action_space = gymnasium.spaces.MultiBinary(2)


class Parts(Walk):
    """A walk that is seen in parts."""

    observation_space = gymnasium.spaces.Dict({"all": Walk.observation_space})


class Film(Walk):
    """A walk that is seen as a picture."""

    observation_space = gymnasium.spaces.Box(0, 255, (36, 36, 3), np.uint8)


@pytest.mark.parametrize(
    ("model", "problem"),
    [
        (lambda: SAC("MlpPolicy", Walk(), **SMALL), "its policy is SACPolicy"),
        (lambda: PPO("MlpPolicy", Binary(), **SMALL), "its action space is MultiBinary"),
        (lambda: PPO("MultiInputPolicy", Parts(), **SMALL), "it observes Dict"),
        (lambda: PPO("CnnPolicy", Film(), **SMALL), "not an array of numbers"),
        (lambda: PPO("MlpPolicy", Film(), **SMALL), "it observes images"),
    ],
)
def test_what_is_no_policy_of_layers_says_so(model, problem, tmp_path):
    with pytest.raises(ConfigError, match=problem):
        save_policy(model(), tmp_path / "policy")
    assert not (tmp_path / "policy").exists()
