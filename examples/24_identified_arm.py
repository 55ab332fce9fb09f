"""From the log of a robot to a policy that works on it: identify, randomize, train, evaluate.

The "real" arm is one in another engine, MuJoCo, whose masses, damping and dry friction nobody
tells: its encoders and torques are noisy, and the torques in its log are late. `physx identify`
finds what the log tells, and training draws each episode's arm from that posterior. MuJoCo stops a
joint over several steps, in which dry friction fades: slow samples are left out. The rivals
train on the arm of the file, alone or with masses within 20 % of it, as one would guess; the real
ones are 15 % off, and the file knows of no dry friction. A plan of torques is trained with an
evolution strategy; feedback is soft, so what the arm does follows from the plan.

    python examples/24_identified_arm.py --picture identified.png
"""

import sys

import numpy as np
from common import SEEDS, options
from environments.soft_arm import HIDDEN, KNOTS, KNOWN, PERIOD, SoftArm, draw, reach, write_log

from physx_gym import RandomizedEnv
from physx_gym.tasks.randomizations import RandomMasses
from physx_identify import identify, read_log, write_identification

FREE, CLOSE = ("mass", "damping", "friction", "delay"), 0.03  # m: what counts as success
SLOWEST = 0.15  # rad/s


def identified(folder, seconds):
    """Write the posterior of the real arm's log to a file; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    write_log(folder / "log.csv", SoftArm(HIDDEN, PERIOD, backend="mujoco"), seconds)
    log = read_log(folder / "log.csv", ["shoulder", "elbow"])
    found = identify(log, KNOWN, FREE, slowest=SLOWEST)
    print(found, flush=True)
    write_identification(folder / "arm.toml", found)
    return folder / "arm.toml"


def train(env, seed, generations, plans=16, episodes=2):
    """Return the plan of torques that a cross-entropy method finds."""
    random, mean = np.random.default_rng(seed), np.zeros((2, KNOTS))
    spread = np.array([[4.0], [1.6]]) * np.ones((2, KNOTS))
    for generation in range(generations):
        tried = mean + spread * random.normal(size=(plans, 2, KNOTS))
        seeds = 10_000 * seed + episodes * generation + np.arange(episodes)
        misses = [np.mean([reach(env, plan, int(each)) for each in seeds]) for plan in tried]
        best = tried[np.argsort(misses)[: plans // 4]]
        mean, spread = best.mean(axis=0), np.maximum(best.std(axis=0), 0.05)
    return mean


def main():
    chosen = options(__doc__).parse_args()
    seeds, generations, episodes = (SEEDS, 25, 20) if not chosen.small else ((0,), 1, 1)
    posterior = identified(chosen.session_dir / "arm", 4.0 if chosen.small else 10.0)
    rivals = {"file alone": [], "masses ±20 %": RandomMasses([0.8, 1.2]), "identified": posterior}
    real, plans, misses = SoftArm(HIDDEN, backend="mujoco"), {}, {}
    print(f"\n{'on the real arm':16}{'reached':>10}{'median miss':>14}   by seed")
    for name, drawn in rivals.items():
        env = RandomizedEnv(SoftArm(KNOWN), randomizations=drawn)
        plans[name] = [train(env, seed, generations) for seed in seeds]
        tried = [[reach(real, plan, seed) for seed in range(episodes)] for plan in plans[name]]
        misses[name] = np.array(tried)
        reached, by_seed = np.mean(misses[name] < CLOSE), np.median(misses[name], axis=1)
        told = ", ".join(f"{100 * each:.1f} cm" for each in by_seed)
        miss = f"{100 * np.median(misses[name]):.1f} cm"
        print(f"{name:16}{reached:10.0%}{miss:>14}   {told}", flush=True)
    if chosen.picture:
        draw(chosen.picture, real, {name: each[0] for name, each in plans.items()})
    most = max(np.mean(misses[name] < CLOSE) for name in ("file alone", "masses ±20 %"))
    return int(not (chosen.small or np.mean(misses["identified"] < CLOSE) > most))


if __name__ == "__main__":
    sys.exit(main())
