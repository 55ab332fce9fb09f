"""Specifications of environments, and information, as trainers and recorders read them."""

import json
import subprocess
import sys
import types

import gymnasium
import pytest
from gymnasium.vector import AutoresetMode

from physx_core.errors import ConfigError
from physx_gym import ComposedEnv, ParallelVectorEnv, RobotEnv, plain
from physx_gym.tasks.quantities import JointPositions
from physx_gym.tasks.rewards import Sum, Survival
from physx_gym.tasks.terminations import OutOfBounds

pytestmark = pytest.mark.processes

IDS = sorted(id for id in gymnasium.registry if id.startswith("physx/"))
SAME_STEP = AutoresetMode.SAME_STEP


@pytest.fixture(params=IDS)
def env(request):
    """Each registered environment."""
    made = gymnasium.make(request.param)
    yield made
    made.close()


def end_of(env, most):
    """Return after how many steps an episode is truncated."""
    env.reset(seed=0)
    for step in range(1, most + 2):
        *_, terminated, truncated, _ = env.step(env.unwrapped.action)
        if terminated or truncated:
            return step if truncated else None
    return None


def test_a_specification_is_plain_data_that_makes_the_environment(env):
    for spec in (gymnasium.spec(env.spec.id), env.spec):
        read = gymnasium.envs.registration.EnvSpec.from_json(spec.to_json())
        assert read == spec
        again = gymnasium.make(read)
        assert again.observation_space == env.observation_space
        again.close()


def test_a_specification_says_when_an_episode_is_truncated(env):
    base, kwargs = env.unwrapped, {"simulation_duration_max": 4.9 * env.unwrapped.step_dt}
    assert env.spec.max_episode_steps == round(base.simulation_duration_max / base.step_dt)
    short = gymnasium.make(env.spec.id, **kwargs)
    assert short.spec.max_episode_steps == 5 == end_of(short, 5)
    assert short.spec.kwargs == kwargs
    again = gymnasium.make(short.spec)
    assert end_of(again, 5) == 5
    short.unwrapped.simulation_duration_max = 3 * base.step_dt
    assert end_of(short, 3) == short.unwrapped.spec.max_episode_steps == 3
    timed = gymnasium.wrappers.TimeAwareObservation(short, flatten=False)
    assert timed.reset()[0]["time"] == 0
    for made in (short, again):
        made.close()


def test_a_specification_of_a_pipeline_is_that_of_its_base():
    gymnasium.register("lab/Composed-v0", entry_point=f"{__name__}:composed")
    try:
        env = gymnasium.make("lab/Composed-v0")
        assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == 25
        assert env.unwrapped.derived.spec.id == plain(env).spec.id == "lab/Composed-v0"
        assert RobotEnv("cartpole", 0.04).spec is None
    finally:
        gymnasium.registry.pop("lab/Composed-v0")


def composed():
    base = RobotEnv("cartpole", 0.04, simulation_duration_max=1.0)
    reward = Sum({Survival("reward"): 2.0, Survival("done"): 1.0})
    late = OutOfBounds(JointPositions(), -1e-9, 1e-9, "moved", grace_period=0.5)
    return ComposedEnv(base, reward=reward, terminations=late)


def test_minari_records_every_environment(env, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    trees = pytest.importorskip("torch.utils._pytree")
    # Minari uses JAX, of 300 MB, only to map nested data.
    jax = types.ModuleType("jax")
    jax.tree_util = types.ModuleType("jax.tree_util")
    jax.tree_util.tree_map = trees.tree_map
    for module in (jax, jax.tree_util):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    collector = minari.DataCollector(env)
    for seed in range(2):
        collector.reset(seed=seed)
        collector.action_space.seed(seed)
        for _ in range(4):
            *_, terminated, truncated, _ = collector.step(collector.action_space.sample())
            if terminated or truncated:
                break
    told = dict.fromkeys(("algorithm_name", "author", "author_email", "code_permalink"), "x")
    dataset = collector.create_dataset(dataset_id="lab/recorded-v0", **told)
    assert dataset.total_episodes == 2
    recovered = dataset.recover_environment()
    assert recovered.spec.id == env.spec.id
    recovered.close()


def test_vectors_of_gymnasium_are_those_of_physx():
    with gymnasium.make_vec("physx/Cartpole-v0", 2, num_processes=1, continuous=True) as many:
        assert type(many) is ParallelVectorEnv
        assert many.single_action_space.shape == (1,)
        again = gymnasium.envs.registration.EnvSpec.from_json(many.spec.to_json())
    with gymnasium.make_vec(again) as many:
        assert type(many) is ParallelVectorEnv and many.num_envs == 2


OWN = """
import gymnasium
from physx_gym.environments.cartpole import CartpoleEnv
class Own(CartpoleEnv):
    pass
gymnasium.register(
    "lab/Own-v0", entry_point=ENTRY, max_episode_steps=7,
    vector_entry_point="physx_gym.vectors:lab/Own-v0")
if __name__ == "__main__":
    many = gymnasium.make_vec("lab/Own-v0", 2, num_processes=1)
    many.reset(seed=0)
    for _ in range(7):
        *_, truncated, _ = many.step(many.action_space.sample() * 0 + 1)
    print(type(many).__name__, truncated.tolist())
    many.close()
"""


@pytest.mark.parametrize("entry", ["Own", '"own_task:Own"'])
def test_vectors_of_an_own_id_are_those_of_physx(entry, tmp_path):
    (tmp_path / "own_task.py").write_text(OWN.replace("ENTRY", entry))
    code = {"Own": ["own_task.py"], '"own_task:Own"': ["-m", "own_task"]}[entry]
    found = subprocess.run(
        [sys.executable, *code], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert found.stdout.strip() == "ParallelVectorEnv [True, True]", found.stderr


# Information ----------------------------------------------------------------------------------


def test_terms_of_the_reward_have_a_name_of_their_own(env):
    env.reset(seed=0)
    _, reward, _, _, info = env.step(env.action_space.sample())
    terms = [value for name, value in info.items() if name.startswith("reward_")]
    assert reward == pytest.approx(sum(terms)) or not terms
    assert not {"reward", "observation", "action", "done", "next"} & info.keys()


def test_terms_may_have_any_name():
    env = composed()
    env.reset(seed=0)
    info = env.step(env.action)[4]
    assert info == {"reward_reward": 1.0, "reward_done": 1.0, "reward_total": 3.0}


class Naming(RobotEnv):
    """Writes an entry when it is told to."""

    name, where, steps = "", "", 1

    def has_terminated(self, info):
        if self.where == "has_terminated" and self.num_steps >= self.steps:
            info[self.name] = 1.0
        return super().has_terminated(info)

    def compute_reward(self, terminated, info):
        if self.where == "compute_reward" and self.num_steps >= self.steps:
            info[self.name] = 1.0
        return 0.0


NAMES = ("reward", "observation", "action", "done", "terminated", "truncated", "next")


@pytest.mark.parametrize("name", [*NAMES, "episode", "final_obs", "terminal_observation"])
@pytest.mark.parametrize("where", ["has_terminated", "compute_reward"])
def test_names_of_trainers_are_refused(name, where):
    env = Naming("cartpole", 0.04)
    env.name, env.where, env.steps = name, where, 2
    env.reset(seed=0)
    env.step(env.action)
    with pytest.raises(ConfigError, match=rf'Naming.*info\["{name}"\].*"my_{name}"'):
        env.step(env.action)
    assert not env.is_simulation_running
    env.steps = 0
    if where == "has_terminated":
        with pytest.raises(ConfigError, match=f'"my_{name}"'):
            env.reset(seed=0)
    env.name = f"my_{name}"
    env.reset(seed=0)
    assert env.step(env.action)[4] == {f"my_{name}": 1.0}


def test_a_layer_that_writes_a_name_of_trainers_is_named():
    class Telling(ComposedEnv):
        def compute_reward(self, terminated, info):
            info["done"] = terminated
            return super().compute_reward(terminated, info)

    env = Telling(RobotEnv("cartpole", 0.04))
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=r'Telling.*info\["done"\]'):
        env.step(env.action)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
@pytest.mark.parametrize("id", ["physx/Ant-v0", "physx/Cartpole-v0"])
def test_torchrl_steps_vectors(id, mode):
    libs = pytest.importorskip("torchrl.envs")
    env = libs.GymWrapper(gymnasium.make_vec(id, 2, num_processes=1, autoreset_mode=mode))
    steps = env.rollout(30, break_when_any_done=False)
    assert steps["next", "reward"].shape == (2, 30, 1)
    env.close()


def test_torchrl_steps_vectors_of_a_composed_task():
    libs = pytest.importorskip("torchrl.envs")
    many = gymnasium.vector.SyncVectorEnv([composed] * 2, autoreset_mode=SAME_STEP)
    env = libs.GymWrapper(many)
    steps = env.rollout(30, break_when_any_done=False)
    assert steps["next", "reward"].shape == (2, 30, 1)
    env.close()


def test_a_log_of_information_is_json(env):
    """As loggers write it: numbers, texts, and what consists of them."""
    env.reset(seed=0)
    json.dumps(env.step(env.action_space.sample())[4])
