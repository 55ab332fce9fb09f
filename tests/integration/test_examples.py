"""Every example runs, and says what it is to show."""

import importlib.util
import re

import gymnasium
import numpy as np
import pytest

from physx_gym import Policy
from physx_gym.cli import evaluate

pytestmark = pytest.mark.slow

pytest.importorskip("torch")


def load(path):
    """Return a script as a module."""
    spec = importlib.util.spec_from_file_location(f"examples_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def number(text, pattern):
    return float(re.search(pattern, text)[1])


def test_equations_of_motion_help_a_network(root, run):
    text = run(root / "examples/physics_informed/run.py", "--small").stdout
    assert number(text, r"make the error ([\d.]+) times smaller") > 5


def test_a_policy_is_trained_and_evaluated(root, run, tmp_path, capsys):
    """The network that is saved acts as the one that was trained."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")
    words = ("--steps", "2048", "--threshold", "50", "--save", str(tmp_path / "policy"))
    text = run(root / "examples/train_ppo.py", *words).stdout
    assert "solved" in text
    evaluate.run([str(tmp_path / "policy"), "--env", "physx/Cartpole-v0", "--backend", "dart"])
    trained, saved = (
        re.search(r"^reward .*", each, re.M)[0] for each in (text, capsys.readouterr().out)
    )
    assert trained == saved


def test_normalization_is_part_of_a_saved_policy(root, tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    example = load(root / "examples/train_ppo.py")
    many = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0), clip_obs=np.inf)
    model = PPO("MlpPolicy", many, seed=0, device="cpu", n_steps=64, batch_size=64, n_epochs=1)
    model.learn(128)
    example.save(tmp_path / "policy", model, many.obs_rms)
    env = gymnasium.make("Pendulum-v1")
    policy = Policy(tmp_path / "policy", env)
    env.observation_space.seed(0)
    for _ in range(20):
        seen = env.observation_space.sample()
        wanted, _ = model.predict(many.normalize_obs(seen), deterministic=True)
        np.testing.assert_allclose(policy(seen), wanted, atol=1e-5)
