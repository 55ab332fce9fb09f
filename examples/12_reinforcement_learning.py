"""Reinforcement learning: PPO on a robot's Gymnasium environment.

physx steps the environments in separate processes, stable-baselines3 learns, and the policy is
saved as a session, which `physx evaluate` runs and films on either engine. It competes with doing
nothing, random actions and, where there is one, a rule of one line. For the cartpole, that is "push
to where the pole leans and falls", which is hard to beat; PPO beats it without knowing mechanics.

    python examples/12_reinforcement_learning.py --picture rewards.png
    python examples/12_reinforcement_learning.py --env Ant --seeds 0  # Acrobot, Quadruped, PushBox
    physx evaluate sessions/Cartpole_0 --env physx/Cartpole-v0 --backend pinocchio
"""

import sys

import gymnasium
import numpy as np
from common import SEEDS, TOO_SMALL, options
from matplotlib.figure import Figure
from ppo import SETTINGS, train

from physx_gym import Policy
from physx_gym.cli.evaluate import evaluate, summary

RULES = {  # of the three actions, 0 and 2 push or turn to either side
    "Cartpole": lambda seen: int(1 + np.sign(seen[1] + seen[3])),  # where the pole will be
    "Acrobot": lambda seen: int(1 + np.sign(seen[5])),  # the way the elbow already turns
}


def main():
    parser = options(__doc__)
    parser.add_argument("--env", default="Cartpole", choices=SETTINGS)
    parser.add_argument("--backend", default="dart", choices=("dart", "pinocchio"))
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--steps", type=int, help="at most; default: as ppo.toml says")
    chosen = parser.parse_args()
    made = {"id": f"physx_gym:physx/{chosen.env}-v0", "backend": chosen.backend}
    env, steps = gymnasium.make(**made), 1024 if chosen.small else chosen.steps
    env.action_space.seed(0)
    still = np.zeros(env.action_space.shape) if env.action_space.shape else 1  # 0 and 2 push
    rivals = {"nothing": lambda _: still, "chance": lambda _: env.action_space.sample()}
    if chosen.env in RULES:
        rivals["rule"] = RULES[chosen.env]
    policies, axes = {}, (figure := Figure((8, 4), layout="constrained")).subplots()
    for seed in chosen.seeds:
        folder = chosen.session_dir / f"{chosen.env}_{seed}"
        curve = train(made, seed, folder, steps)
        policies[f"PPO, seed {seed}"] = Policy(folder, env)
        axes.plot(*np.transpose(curve), "o-", label=f"PPO, seed {seed}")
    print(f"\n{'reward of an episode':24}{'mean':>10}{'worst':>10}")
    means = {}
    for number, (name, act) in enumerate((rivals | policies).items()):
        reward = summary(evaluate(env, act, range(20_000, 20_020)))["reward"]
        means[name] = reward["mean"]
        print(f"{name:24}{reward['mean']:>10.1f}{reward['min']:>10.1f}")
        if name in rivals:
            axes.axhline(means[name], color="0.3", dashes=(1 + 3 * number, 2), label=name)
    worst, best = min(means[name] for name in policies), max(means[name] for name in rivals)
    compared = f"worst seed {worst:.1f}, best rival {best:.1f}"
    print(f"\n{TOO_SMALL if chosen.small else compared}")
    axes.set(xlabel="steps", ylabel="reward of an episode", title=f"physx/{chosen.env}-v0")
    axes.legend()
    if chosen.picture:
        figure.savefig(chosen.picture)
    return 0 if chosen.small else int(worst < best)


if __name__ == "__main__":
    sys.exit(main())
