"""A policy trained on a Ray cluster, bit-identical to one trained locally.

A launcher is all that a vector environment needs to run its processes elsewhere: here on two
single-core nodes started for this run, or on any running cluster. PPO from stable-baselines3 learns
on the cluster and with local processes: every parameter of the two policies is equal.

    python examples/20_policy_on_a_cluster.py --picture cluster.png
    python examples/20_policy_on_a_cluster.py --address HOST:PORT      # of a cluster's head node
"""

import sys

import gymnasium
import numpy as np
import torch
from common import options
from matplotlib.figure import Figure
from ray.cluster_utils import Cluster
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import physx_gym  # noqa: F401 - registers the environments
from physx_gym.cli.evaluate import evaluate, summary
from physx_gym.stable_baselines3 import GymnasiumVecEnv

CARTPOLE = "physx/Cartpole-v0"


def learn(steps, **launch):
    """Train a policy; return its parameters, and steps and reward at the end of each episode."""
    options = {"num_processes": 2, "autoreset_mode": "SameStep", **launch}
    envs = VecMonitor(GymnasiumVecEnv(gymnasium.make_vec(CARTPOLE, 8, **options)))
    ppo = {"n_steps": 64, "batch_size": 256, "n_epochs": 20, "gamma": 0.98, "seed": 0}
    model = PPO("MlpPolicy", envs, 1e-3, **ppo)
    ends = []

    def note(local, _):
        told = [info["episode"]["r"] for info in local["infos"] if "episode" in info]
        ends.extend((local["self"].num_timesteps, reward) for reward in told)
        return True

    try:
        model.learn(steps, note)
    finally:
        envs.close()
    return torch.cat([each.detach().ravel() for each in model.policy.parameters()]), np.array(ends)


def main():
    (parser := options(__doc__)).add_argument("--address", help="HOST:PORT of Ray's head node")
    chosen = parser.parse_args()
    steps, env, cluster = 1024 if chosen.small else 20_000, gymnasium.make(CARTPOLE), None
    env.action_space.seed(0)
    chance = summary(evaluate(env, lambda _: env.action_space.sample(), range(20)))["reward"]
    here, _ = learn(steps)
    if chosen.address is None:
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        cluster.add_node(num_cpus=1)
    address = {"address": chosen.address or cluster.address}
    try:
        there, ends = learn(steps, launcher="cluster/ray", launcher_kwargs=address)
    finally:
        if cluster is not None:
            cluster.shutdown()
    last, same = ends[-max(1, len(ends) // 10) :, 1].mean(), torch.equal(here, there)
    print(f"\n{len(there)} parameters of the policy, equal to those learned here: {same}")
    print(f"reward of an episode: chance {chance['mean']:.1f}, at last {last:.1f}")
    axes = (figure := Figure((8, 4), layout="constrained")).subplots()
    axes.plot(*ends.T, ".", label="on the cluster")
    axes.axhline(chance["mean"], color="0.3", label="chance")
    axes.set(xlabel="steps", ylabel="reward of an episode", title=CARTPOLE)
    axes.legend()
    if chosen.picture:
        figure.savefig(chosen.picture)
    return int(not same or not (chosen.small or last > 5 * chance["mean"]))


if __name__ == "__main__":
    sys.exit(main())
