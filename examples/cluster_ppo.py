"""Train a policy with stable-baselines3 whose environments run on the nodes of a Ray cluster.

    python examples/cluster_ppo.py                          # two nodes of one core, started here
    python examples/cluster_ppo.py --address HOST:PORT      # a cluster that runs

The environments are those of ``gymnasium.make_vec``; the adapter below is all that they need to be
taken by stable-baselines3. Prints the mean return of the first and the last episodes, and exits
with 1 if the policy did not improve.
"""

import argparse
import sys

import gymnasium
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import physx_gym  # noqa: F401 - registers the environments


class GymnasiumVector(VecEnv):
    """A vector environment of Gymnasium, made with ``autoreset_mode="SameStep"``."""

    def __init__(self, vector):
        self.vector, self.seeds = vector, None
        self.render_mode = vector.render_mode
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )

    def reset(self):
        seeds, self.seeds = self.seeds, None
        return self.vector.reset(seed=seeds)[0]

    def seed(self, seed=None):
        self.seeds = seed
        return [seed + number for number in range(self.num_envs)]

    def step_async(self, actions):
        self.vector.send(actions)

    def step_wait(self):
        seen, rewards, terminated, truncated, infos = self.vector.recv()
        each = [{"TimeLimit.truncated": bool(cut)} for cut in truncated & ~terminated]
        for number in np.flatnonzero(terminated | truncated):
            each[number]["terminal_observation"] = infos["final_obs"][number]
        return seen, rewards.astype(np.float32), terminated | truncated, each

    def close(self):
        self.vector.close()

    def get_attr(self, attr_name, indices=None):
        found = self.vector.get_attr(attr_name)
        return [found[number] for number in self._get_indices(indices)]

    def set_attr(self, attr_name, value, indices=None):
        self.vector.set_attr(attr_name, value)

    def env_method(self, method_name, *args, indices=None, **kwargs):
        found = self.vector.call(method_name, *args, **kwargs)
        return [found[number] for number in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * len(list(self._get_indices(indices)))


def two_nodes():
    """Start a cluster of two nodes with a core each; return it."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    return cluster


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--env", default="physx/Cartpole-v0")
    parser.add_argument("--address", help="HOST:PORT of Ray's head node")
    parser.add_argument("--launcher", default="cluster/ray")
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    cluster = None
    if options.launcher == "cluster/ray" and options.address is None:
        cluster = two_nodes()
        options.address = cluster.address
    kwargs = {"address": options.address} if options.launcher == "cluster/ray" else {}
    launch = {"launcher": options.launcher, "launcher_kwargs": kwargs, "num_processes": 2}
    vector = gymnasium.make_vec(options.env, 8, autoreset_mode="SameStep", **launch)
    envs = VecMonitor(GymnasiumVector(vector))
    returns = []

    def note(local, _):
        returns.extend(info["episode"]["r"] for info in local["infos"] if "episode" in info)
        return True

    try:
        model = PPO(
            "MlpPolicy", envs, 1e-3, n_steps=64, batch_size=256, n_epochs=20, gamma=0.98, seed=0
        )
        model.learn(options.steps, note)
    finally:
        envs.close()
        if cluster is not None:
            cluster.shutdown()
    tenth = max(1, len(returns) // 10)
    first, last = np.mean(returns[:tenth]), np.mean(returns[-tenth:])
    print(f"{len(returns)} episodes; mean return at first {first:.1f}, at last {last:.1f}")
    return 0 if last > 1.5 * first else 1


if __name__ == "__main__":
    sys.exit(main())
