"""PPO from stable-baselines3 on the environments of physx_gym, with the settings in ppo.toml."""

import tomllib
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from physx_gym.cli.evaluate import evaluate, summary
from physx_gym.stable_baselines3 import GymnasiumVecEnv, save_policy

SETTINGS = tomllib.loads(Path(__file__).with_name("ppo.toml").read_text())


def train(made, seed, folder, steps=None):
    """Train a policy and save it; return pairs of step count and mean reward.

    Test episodes run between the parts of the training, with seeds used for nothing else. The
    policy saved is the first that is good enough, or else the one with the highest mean reward.

    Args:
        made: Arguments of `gymnasium.make`.
        seed: Seed of the training.
        folder: Folder of the session in which the policy is saved.
        steps: Number of steps; None: as in ppo.toml.
    """
    ppo = dict(SETTINGS[made["id"].split("/")[1].removesuffix("-v0")])
    limit, part, count = (ppo.pop(name) for name in ("steps", "part", "n_envs"))
    enough, episodes = ppo.pop("enough", {}), range(10_000, 10_000 + ppo.pop("episodes", 20))
    normalize, test, curve = ppo.pop("normalize", False), gymnasium.make(**made), []
    envs = VecMonitor(
        GymnasiumVecEnv(gymnasium.make_vec(num_envs=count, autoreset_mode="SameStep", **made))
    )
    if normalize:  # without clipping, because the saved policy does not clip
        envs = VecNormalize(envs, gamma=ppo["gamma"], clip_obs=np.inf)
    model, reached = PPO("MlpPolicy", envs, seed=seed, device="cpu", **ppo), False

    def act(seen):
        return model.predict(envs.normalize_obs(seen) if normalize else seen, deterministic=True)[0]

    while model.num_timesteps < (steps or limit) and not reached:
        model.learn(part if steps is None else steps, reset_num_timesteps=False)
        found = summary(evaluate(test, act, episodes))
        curve.append((model.num_timesteps, found["reward"]["mean"]))
        reached = enough and all(found[name]["mean"] >= least for name, least in enough.items())
        if reached or curve[-1][1] == max(reward for _, reward in curve):
            save_policy(model, folder)
        print(f"seed {seed}, {curve[-1][0]:7d} steps: reward {curve[-1][1]:.1f}", flush=True)
    envs.close()
    return curve
