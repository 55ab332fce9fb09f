"""The registered environments, on every engine that can run them."""

import contextlib
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from physx_core.errors import ConfigError, EpisodeError
from physx_gym import RobotEnv
from physx_gym.bridge.make_env import make_env

pytestmark = pytest.mark.processes

ENGINES = ("dart", "pinocchio")
GOALS = ("ArmReachGoal", "PushBoxGoal")
NAMES = ("Cartpole", "Acrobot", "Ant", "Quadruped", "ArmReach", "PushBox", *GOALS)
ALL = [(n, b) for n in NAMES for b in ENGINES]
STEPS = {"pinocchio": 12, "dart": 40}


class Plain(gymnasium.Env):
    """Hides `compute_reward`, which stable-baselines3 takes for that of a goal environment."""

    def __init__(self, env):
        self.env, self.metadata = env, env.metadata
        self.observation_space, self.action_space = env.observation_space, env.action_space

    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=seed, options=options)

    def step(self, action):
        return self.env.step(action)


def make(name, backend, **options):
    return gymnasium.make(f"physx/{name}-v0", backend=backend, **options)


def actions_of(env, count, seed=0):
    env.action_space.seed(seed)
    return [env.action_space.sample() for _ in range(count)]


def flat(env, observation):
    return gymnasium.spaces.flatten(env.observation_space, observation)


def run(env, actions, seed):
    observations, rewards = [flat(env, env.reset(seed=seed)[0])], []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(flat(env, observation))
        rewards.append(reward)
        if terminated or truncated:
            observations.append(flat(env, env.reset()[0]))
    return np.array(observations), np.array(rewards)


@pytest.mark.parametrize(
    "program",
    [
        'import gymnasium; env = gymnasium.make("physx_gym:physx/Cartpole-v0")',
        'import gymnasium, physx_gym; env = gymnasium.make("physx/Cartpole-v0")',
    ],
)
def test_environments_are_registered_by_the_import(program):
    program += "; env.reset(seed=0); print(env.unwrapped.spec.id)"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    assert done.stdout.decode().strip() == "physx/Cartpole-v0"


def test_an_id_may_name_the_module_that_registers_it(nothing_stays_behind):
    name = "physx_gym:physx/Cartpole-v0"
    assert make_env(name, {}).unwrapped.spec.id == "physx/Cartpole-v0"
    with contextlib.closing(gymnasium.make_vec(name, num_envs=1)) as env:
        assert env.reset(seed=0)[0].shape == (1, 4)


@pytest.mark.parametrize(("name", "backend"), ALL)
def test_checkers_find_nothing(name, backend):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = make(name, backend)
        check_env(env.unwrapped, skip_render_check=True)
        sb3_check_env(env.unwrapped if name in GOALS else Plain(env), skip_render_check=True)
    env.close()


@pytest.mark.parametrize(("name", "backend"), ALL)
def test_the_same_seed_gives_the_same_bits(name, backend):
    env, other = make(name, backend), make(name, backend)
    assert isinstance(env.unwrapped, RobotEnv)
    actions = actions_of(env, STEPS[backend])
    first = run(env, actions, 3)
    run(env, actions_of(env, 5, seed=1), 8)
    for again in (run(env, actions, 3), run(other, actions, 3)):
        for one, two in zip(first, again, strict=True):
            np.testing.assert_array_equal(one, two)
    assert not np.array_equal(first[0][0], flat(env, env.reset(seed=4)[0]))
    copied = pickle.loads(pickle.dumps(other.unwrapped))  # noqa: S301 - our own
    state = env.unwrapped.snapshot()
    one = [flat(env, env.step(action)[0]) for action in actions[:3]]
    env.unwrapped.restore(state)
    two = [flat(env, env.step(action)[0]) for action in actions[:3]]
    np.testing.assert_array_equal(one, two)
    again = flat(env, copied.step(actions[0])[0])
    np.testing.assert_array_equal(again, flat(env, other.step(actions[0])[0]))


def test_a_pole_that_falls_terminates_and_time_truncates():
    env = make("Cartpole", "dart", continuous=True)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (1,))
    env.reset(seed=0)
    for steps in range(1, 500):  # noqa: B007
        _, reward, terminated, truncated, _ = env.step(np.ones(1, np.float32))
        assert reward == 1.0
        if terminated or truncated:
            break
    assert (terminated, truncated) == (True, False)
    assert 5 < steps < 60
    env = make("Cartpole", "dart", simulation_duration_max=0.1)
    env.reset(seed=0)
    ends = [env.step(1)[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]


def test_an_acrobot_above_the_bar_terminates():
    env = make("Acrobot", "pinocchio").unwrapped
    env.reset(seed=0)
    env._sample_state = lambda: (np.array([np.pi, 0.0]), np.zeros(2))
    with pytest.raises(EpisodeError, match="terminated in its initial state"):
        env.reset()
    env._sample_state = lambda: (np.array([1.5, 0.0]), np.array([6.0, 0.0]))
    env.reset()
    rewards, terminated = [], False
    while not terminated:
        _, reward, terminated, truncated, _ = env.step(1)
        rewards.append(reward)
        assert not truncated
    assert rewards == [-1.0] * (len(rewards) - 1) + [0.0]


@pytest.mark.parametrize("name", ["Ant", "Quadruped"])
def test_legged_robots_stand_fall_and_report_their_rewards(name):
    env = make(name, "dart")
    env.reset(seed=0)
    for _ in range(20):
        _, reward, terminated, truncated, info = env.step(np.zeros(env.action_space.shape))
        assert reward == pytest.approx(
            sum(value for name, value in info.items() if name.startswith("reward_"))
        )
        assert not (terminated or truncated)
    base = env.unwrapped
    state = base.robot_state.q.copy()
    state[2] += 1.0
    state[3:7] = [1.0, 0.0, 0.0, 0.0]  # upside down
    base.simulator.simulation.set_state(state, np.zeros(len(base.robot_state.v)))
    assert env.step(np.zeros(env.action_space.shape))[2]


def test_an_ant_has_the_options_of_gymnasiums():
    """As Ant-v5 defines them: weights, noise, what is healthy, whether that ends an episode."""
    still = np.zeros(8, np.float32)
    options = {"reset_noise_scale": 0.0, "exclude_current_positions_from_observation": False}
    stands = {"healthy_z_range": (0.3, 0.4)}
    env = make("Ant", "dart", terminate_when_unhealthy=False, **options, **stands)
    first, _ = env.reset(seed=0)
    assert env.observation_space.shape == first.shape == (29,)
    np.testing.assert_array_equal(first[:2], 0.0)
    np.testing.assert_array_equal(first, env.reset(seed=1)[0])
    weights = {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.5, "healthy_reward": 3.0}
    other = make("Ant", "dart", **weights, **stands)
    other.reset(seed=0)
    push = np.full(8, 0.125, np.float32)
    *_, info = other.step(push)
    forward = 2.0 * info["x_velocity"]
    parts = {"reward_forward": forward, "reward_survival": 3.0, "reward_effort": -0.0625}
    assert {name: info[name] for name in parts} == pytest.approx(parts)
    assert other.unwrapped.robot_state.q[:2].tolist() == [info["x_position"], info["y_position"]]
    ends = [lie_down(each).step(still) for each in (env, other)]
    assert [end[2] for end in ends] == [False, True]
    assert [end[4]["reward_survival"] for end in ends] == [0.0, 0.0]
    with pytest.raises(ConfigError, match="healthy_z_range has 1 numbers but needs 2"):
        make("Ant", "dart", healthy_z_range=(0.2,))


def lie_down(env):
    base = env.unwrapped
    state = base.robot_state.q.copy()
    state[2], state[7:] = 0.2, np.tile([0.0, 0.4], 4)
    base.simulator.simulation.set_state(state, np.zeros(14))
    return env


def test_a_quadruped_is_rewarded_for_its_heading():
    env = make("Quadruped", "dart")
    env.reset(seed=0)
    base = env.unwrapped
    for heading, part in ((0.0, 0.5), (0.5, 0.5 * np.exp(-1.0)), (-0.5, 0.5 * np.exp(-1.0))):
        state = base.robot_state.q.copy()
        state[3:7] = 0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2)
        base.simulator.simulation.set_state(state, np.zeros(18))
        seen, *_, info = env.step(np.zeros(12))
        np.testing.assert_allclose(seen[45:], [np.cos(heading), np.sin(heading)], atol=0.02)
        assert info["reward_heading"] == pytest.approx(part, abs=0.02)


@pytest.mark.parametrize("name", GOALS)
def test_rewards_of_goals_depend_on_the_goals_alone(name):
    env, dense = make(name, "dart"), make(name, "dart", reward_type="dense")
    for each in (env, dense):
        each.reset(seed=0)
    for action in actions_of(env, 5):
        seen, reward, terminated, _, info = env.step(action)
        wanted, reached = seen["desired_goal"], seen["achieved_goal"]
        assert (reward, terminated, info["is_success"]) == (-1.0, False, False)
        _, away, *_ = dense.step(action)
        assert away == pytest.approx(-np.linalg.norm(wanted - reached))
    base = env.unwrapped
    near = reached + 0.9 * base.CLOSE * np.eye(len(reached))[0]
    rewards = base.compute_reward(np.stack([reached] * 2), np.stack([wanted, near]), [{}, {}])
    np.testing.assert_array_equal(rewards, [-1.0, 0.0])
    assert base.compute_reward(reached, near, {}) == 0.0
    assert not base.compute_terminated(reached, near, {})
    task = make(name.removesuffix("Goal"), "dart")
    whole, _ = task.reset(seed=0)
    parts, _ = env.reset(seed=0)
    way = parts["desired_goal"] - parts["achieved_goal"]
    np.testing.assert_array_equal(whole, np.concatenate([parts["observation"], way]))
    with pytest.raises(ConfigError, match="reward_type"):
        make(name, "dart", reward_type="scarce")


def test_hindsight_replaces_goals():
    env = make("ArmReachGoal", "dart", simulation_duration_max=0.4)
    options = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
    model = SAC(
        "MultiInputPolicy", env, seed=0, device="cpu", learning_starts=20, batch_size=32,
        buffer_size=100, replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=options,
        policy_kwargs={"net_arch": [8]},
    )  # fmt: skip
    model.learn(40)
    rewards = model.replay_buffer.sample(200, None).rewards
    assert set(np.unique(rewards)) == {-1.0, 0.0}


@pytest.mark.parametrize("backend", ENGINES)
def test_an_arm_holds_its_pose_and_follows_commands(backend):
    env = make("ArmReach", backend)
    env.reset(seed=0)
    for _ in range(20):
        first = env.step(np.zeros(7, np.float32))[0]
    for _ in range(5):
        held, reward, *_, info = env.step(np.zeros(7, np.float32))
    np.testing.assert_allclose(held[:7], first[:7], atol=1e-4)
    assert reward == pytest.approx(-np.linalg.norm(held[17:]))
    assert info["is_success"] == (np.linalg.norm(held[17:]) < 0.05)
    for _ in range(10):
        moved, *_ = env.step(np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    assert moved[6] - held[6] == pytest.approx(1.5 * 0.4, abs=0.15)


@pytest.mark.parametrize("backend", ["dart", "pinocchio"])
def test_a_box_is_pushed_to_its_goal(backend):
    env = make("PushBox", backend)
    observation, _ = env.reset(seed=1)
    for _ in range(200):
        observation, reward, terminated, truncated, info = env.step(push(observation))
        if terminated or truncated:
            break
    assert terminated
    assert info["is_success"]
    assert reward > 9.0


def push(observation):
    """Go around the box, behind it, then push it towards the goal."""
    stick, speed, box, way = (observation[i : i + 2] for i in (0, 2, 4, 13))
    way = way / max(np.linalg.norm(way), 1e-9)
    aside = np.array([-way[1], way[0]])
    along, across = (stick - box) @ way, (stick - box) @ aside
    if along < -0.1 and abs(across) < 0.1:
        target = box + 0.2 * way - 2.0 * across * aside
    elif along < -0.26:
        target = box - 0.3 * way
    elif abs(across) > 0.27:
        target = box - 0.35 * way + across * aside
    else:
        target = stick + 0.3 * np.sign(across or 1.0) * aside
    return np.clip(6.0 * (target - stick) - 1.0 * speed, -1, 1).astype(np.float32)


def test_make_vec_runs_them_in_processes(nothing_stays_behind):
    env = gymnasium.make_vec("physx/Cartpole-v0", num_envs=2, num_processes=2, backend="dart")
    try:
        single = make("Cartpole", "dart")
        first, _ = env.reset(seed=5)
        np.testing.assert_array_equal(first[0], single.reset(seed=5)[0])
        many, *_ = env.step(np.array([2, 0]))
        np.testing.assert_array_equal(many[0], single.step(2)[0])
    finally:
        env.close()


class Own(RobotEnv):
    """Has attributes whose names an environment might use itself."""

    def __init__(self):
        super().__init__("cartpole", 0.02)
        self.names = ["_last", "_count", "_ready", "_why", "_copies", "_n", "_state", "_actions"]
        for name in self.names:
            setattr(self, name, "mine")

    def _run(self):
        raise AssertionError("this is not to be called")

    _begin = _refusal = _attend = _run

    def compute_reward(self, terminated, info):
        return float(all(getattr(self, name) == "mine" for name in self.names))


def test_subclasses_may_use_any_attribute_names():
    env = Own()
    env.reset(seed=0)
    assert env.step(np.ones(2))[1] == 1.0
    state = env.snapshot()
    following = env.step(np.ones(2))[0]["states"]["agent"]["q"]
    for other in (env, pickle.loads(pickle.dumps(env)), Own()):  # noqa: S301 - our own
        other.restore(state)
        np.testing.assert_array_equal(other.step(np.ones(2))[0]["states"]["agent"]["q"], following)
    env.stop()
    with pytest.raises(EpisodeError, match="stopped"):
        env.step(np.ones(2))
