"""What the examples with robots say is so: policies that are saved, gaits, pushes."""

import json
import math
import re

import gymnasium
import pytest

from physx_gym import Policy
from physx_gym.cli import evaluate

pytestmark = [pytest.mark.slow, pytest.mark.processes]


def test_a_policy_is_trained_and_evaluated(root, run, tmp_path, capsys):
    """The network that is saved acts as the one that was trained."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")
    folder = tmp_path / "policies"
    words = ["--small", "--seeds", "3", "--session-dir", folder]
    text = run(root / "examples/12_reinforcement_learning.py", *words).stdout
    mean, worst = re.search(r"^PPO, seed 3 +([\d.]+) +([\d.]+)$", text, re.MULTILINE).groups()
    words = ["--env", "physx/Cartpole-v0", "--seed", "20000", "--json"]
    evaluate.run([str(folder / "Cartpole_3"), *words])
    found = capsys.readouterr().out
    figures = json.loads(found)["summary"]["reward"]
    assert (f"{figures['mean']:.1f}", f"{figures['min']:.1f}") == (mean, worst)


@pytest.mark.faults
@pytest.mark.parametrize("name", ["Acrobot", "Ant", "Quadruped", "PushBox"])
def test_the_settings_of_each_environment_train_a_policy(name, root, tmp_path, monkeypatch):
    """As benchmarks/learning.py does, which takes as many steps as it needs."""
    pytest.importorskip("stable_baselines3", reason="needs stable-baselines3")
    monkeypatch.syspath_prepend(str(root / "examples"))
    import ppo

    assert set(ppo.SETTINGS) == {"Cartpole", "Acrobot", "Ant", "Quadruped", "PushBox"}
    monkeypatch.setitem(ppo.SETTINGS[name], "episodes", 1)
    [(steps, reward)] = ppo.train({"id": f"physx/{name}-v0"}, 0, tmp_path / name, 1)
    assert steps > 1000 and math.isfinite(reward)
    env = gymnasium.make(f"physx/{name}-v0")
    assert env.action_space.contains(Policy(tmp_path / name, env)(env.reset(seed=0)[0]))
