"""Train a policy for a registered environment with PPO of stable-baselines3.

    pip install stable-baselines3
    python examples/train_ppo.py                               # physx/Cartpole-v0 on DART
    python examples/train_ppo.py --env physx/Ant-v0 --save ant # a session: physx evaluate ant ...
    python examples/train_ppo.py --env physx/Acrobot-v0 --backend pinocchio

Trains for the steps that are set for the environment, or until deterministic episodes reach its
threshold of the mean reward, or succeed in 95 of 100. Prints rewards, lengths, speeds and successes
of the last such episodes as a table, and exits with 1 if the threshold was missed.
"""

import argparse
import sys
import time
import tomllib
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import physx_gym  # noqa: F401 - registers the environments
from physx_core import Field, NetworkConfig, Normalization
from physx_core.checkpoint import Progress
from physx_core.pipelines import Learner
from physx_gym.cli.evaluate import evaluate, print_table, summary

WALKING = {
    "steps": 400_000, "n_envs": 8, "batch_size": 512, "n_epochs": 10, "learning_rate": 3e-4,
    "normalize": True, "part": 50_000, "episodes": 5,
}  # fmt: skip
SETTINGS = {
    "physx/Cartpole-v0": {
        "n_steps": 64, "batch_size": 256, "n_epochs": 20, "gamma": 0.98, "gae_lambda": 0.8,
        "learning_rate": 1e-3, "ent_coef": 0.0,
    },
    "physx/Acrobot-v0": {
        "n_steps": 256, "batch_size": 512, "n_epochs": 10, "gamma": 0.99, "gae_lambda": 0.94,
        "learning_rate": 1e-3, "ent_coef": 0.01,
    },
    "physx/Ant-v0": {
        **WALKING, "n_steps": 256, "gamma": 0.98, "gae_lambda": 0.9,
        "policy_kwargs": {"net_arch": [128, 128]},
    },
    "physx/Quadruped-v0": {
        **WALKING, "n_steps": 512, "gamma": 0.99, "gae_lambda": 0.95,
        "policy_kwargs": {"net_arch": [128, 128], "log_std_init": -0.7},
    },
    "physx/PushBox-v0": {
        "steps": 1_000_000, "n_envs": 16, "n_steps": 128, "batch_size": 256, "n_epochs": 10,
        "gamma": 0.98, "learning_rate": 3e-4, "policy_kwargs": {"net_arch": [128, 128]},
        "normalize": True, "part": 25_000, "episodes": 40,
    },
}  # fmt: skip
"""Options of PPO, and ``steps``: how many at most, ``n_envs``: environments, ``normalize``: whether
observations and rewards are normalized, ``part``: steps between two evaluations, ``episodes``: how
many each of these has."""
RATE = 0.95
"""Share of successes at which a task that has them is solved."""
OTHERS = {"n_steps": 256, "batch_size": 512, "n_epochs": 10, "learning_rate": 3e-4}


def save(folder, model, normalization):
    """Write the policy as a session that `physx_gym.Policy` and ``physx evaluate`` read.

    Args:
        folder: The session's folder.
        model: The model, whose policy is an `MlpPolicy`.
        normalization: Mean and variance of the observation; None: it is not normalized.
    """
    policy, seen = model.policy, model.observation_space
    layers = torch.nn.Sequential(*policy.mlp_extractor.policy_net, policy.action_net)
    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    sizes = [linear[0].in_features, *(layer.out_features for layer in linear)]
    kwargs = {"layers": sizes, "activation": policy.activation_fn.__name__}
    kwargs |= {"net_fields": "observation", "opt_fields": "action"}
    config = NetworkConfig(
        "torch/fc", network_kwargs=kwargs, loss="MSELoss", optimizer="Adam", lr=0.0
    )
    learner = Learner(config, trains=True)
    fields = [
        Field("observation", seen.shape, seen.dtype),
        Field("action", (sizes[-1],), "float32"),
    ]
    known = {}
    if normalization is not None:
        scale = np.sqrt(normalization.var + 1e-8)
        known["observation"] = Normalization(normalization.mean, scale)
    learner.bind({field.name: field for field in fields}, known)
    learner.network.layers.load_state_dict(layers.state_dict())
    Path(folder).mkdir(parents=True, exist_ok=True)
    learner.save(Path(folder) / "network", Progress(0, 0, 0, model.seed or 0))


def is_solved(found, least):
    """Return whether a mean reward, or else the share of successes, is reached; None: no target."""
    if least is not None:
        return found["reward"]["mean"] >= least
    return found["success"]["mean"] >= RATE if "success" in found else None


def option(word):
    """Return name and value of ``NAME=VALUE``, whose value is TOML."""
    name, _, text = word.partition("=")
    return name, tomllib.loads(f"value = {text}")["value"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="physx/Cartpole-v0")
    parser.add_argument("--backend", default="dart")
    parser.add_argument("--steps", type=int, help="at most; default: as set for the environment")
    parser.add_argument("--threshold", type=float, help="mean reward; default: the environment's")
    parser.add_argument("--seed", type=int, default=0)
    pairs = {"nargs": "+", "type": option, "default": [], "metavar": "NAME=VALUE"}
    parser.add_argument("--ppo", **pairs, help="options that replace those set for it")
    parser.add_argument("--env-kwargs", **pairs, help="options of the environment")
    parser.add_argument("--save", metavar="FOLDER", help="where to write the policy")
    chosen = parser.parse_args()

    torch.set_num_threads(1)
    settings = SETTINGS.get(chosen.env, OTHERS) | dict(chosen.ppo)
    n_envs, part = settings.pop("n_envs", 8), settings.pop("part", 10_000)
    episodes = settings.pop("episodes", 20)
    steps = settings.pop("steps", 200_000) if chosen.steps is None else chosen.steps
    settings.pop("steps", None)
    options = {"backend": chosen.backend, **dict(chosen.env_kwargs)}
    many = make_vec_env(chosen.env, n_envs=n_envs, seed=chosen.seed, env_kwargs=options)
    normalizer = None
    if settings.pop("normalize", False):  # without clipping, as the saved network does not clip
        many = normalizer = VecNormalize(many, gamma=settings["gamma"], clip_obs=np.inf)
    judge = gymnasium.make(chosen.env, **options)
    least = chosen.threshold if chosen.threshold is not None else judge.spec.reward_threshold
    model = PPO("MlpPolicy", many, seed=chosen.seed, device="cpu", verbose=0, **settings)

    def act(observation):
        if normalizer is not None:
            observation = normalizer.normalize_obs(observation)
        return model.predict(observation, deterministic=True)[0]

    begin = time.perf_counter()
    while model.num_timesteps < steps:
        model.learn(min(part, steps - model.num_timesteps), reset_num_timesteps=False)
        found = summary(evaluate(judge, act, range(10_000, 10_000 + episodes)))
        text = ", ".join(f"{name} {found[name]['mean']:.4g}" for name in found)
        elapsed = time.perf_counter() - begin
        print(f"{model.num_timesteps:7d} steps, {elapsed:5.0f} s: {text}", flush=True)
        solved = is_solved(found, least)
        if solved:
            break
    if chosen.save:
        save(chosen.save, model, None if normalizer is None else normalizer.obs_rms)
        print(f"policy: {chosen.save}")
    print(f"\n{chosen.env} on {chosen.backend}, seed {chosen.seed}: deterministic episodes")
    print_table(found)
    if solved is None:
        return 0
    print(f"\n{'solved' if solved else 'not solved'} after {model.num_timesteps} steps")
    return 0 if solved else 1


if __name__ == "__main__":
    sys.exit(main())
