"""Train a policy for a registered environment with PPO of stable-baselines3.

    pip install stable-baselines3
    python examples/train_ppo.py                       # physx/Cartpole-v0 on DART
    python examples/train_ppo.py --backend pinocchio
    python examples/train_ppo.py --env physx/Acrobot-v0

Stops as soon as the mean reward of 20 evaluation episodes reaches the environment's threshold,
prints it, and exits with 1 if that does not happen within `--steps` steps.
"""

import argparse
import sys
import time

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import physx_gym  # noqa: F401 - registers the environments

SETTINGS = {
    "physx/Cartpole-v0": {
        "n_steps": 64, "batch_size": 256, "n_epochs": 20, "gamma": 0.98, "gae_lambda": 0.8,
        "learning_rate": 1e-3, "ent_coef": 0.0,
    },
    "physx/Acrobot-v0": {
        "n_steps": 256, "batch_size": 512, "n_epochs": 10, "gamma": 0.99, "gae_lambda": 0.94,
        "learning_rate": 1e-3, "ent_coef": 0.01,
    },
}  # fmt: skip
OTHERS = {"n_steps": 256, "batch_size": 512, "n_epochs": 10, "learning_rate": 3e-4}


def mean_reward(model, env, episodes, seed=10_000):
    """Return the mean total reward of deterministic episodes with seeds of their own."""
    totals = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        total, over = 0.0, False
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, terminated, truncated, _ = env.step(action)
            total, over = total + reward, terminated or truncated
        totals.append(total)
    return float(np.mean(totals))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="physx/Cartpole-v0")
    parser.add_argument("--backend", default="dart")
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--threshold", type=float, help="mean reward; default: the environment's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", help="file for the policy")
    chosen = parser.parse_args()

    torch.set_num_threads(1)
    options = {"backend": chosen.backend}
    many = make_vec_env(chosen.env, n_envs=8, seed=chosen.seed, env_kwargs=options)
    judge = gymnasium.make(chosen.env, **options)
    threshold = chosen.threshold if chosen.threshold is not None else judge.spec.reward_threshold
    settings = SETTINGS.get(chosen.env, OTHERS)
    model = PPO("MlpPolicy", many, seed=chosen.seed, device="cpu", verbose=0, **settings)
    begin, reached = time.perf_counter(), -np.inf
    while model.num_timesteps < chosen.steps:
        part = min(10_000, chosen.steps - model.num_timesteps)
        model.learn(part, reset_num_timesteps=model.num_timesteps == 0)
        reached = mean_reward(model, judge, 20)
        elapsed = time.perf_counter() - begin
        print(f"{model.num_timesteps:7d} steps, {elapsed:5.0f} s: mean reward {reached:.1f}")
        if threshold is not None and reached >= threshold:
            break
    if chosen.save:
        model.save(chosen.save)
    solved = threshold is None or reached >= threshold
    word = "solved" if solved else "not solved"
    print(f"{chosen.env} on {chosen.backend}: {word}, {model.num_timesteps} steps, {reached:.1f}")
    return 0 if solved else 1


if __name__ == "__main__":
    sys.exit(main())
