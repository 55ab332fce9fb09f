"""What comes of a seed in each registered environment, in this process or as a program."""

import hashlib
import sys

import gymnasium

import physx_gym  # noqa: F401 - registers them

NAMES = ("Cartpole", "Acrobot", "Ant", "Quadruped", "ArmReach", "PushBox")
ALL = [(name, backend) for name in NAMES for backend in ("dart", "pinocchio")]


def run(env, seed, steps=4):
    observation, _ = env.reset(seed=seed)
    found = hashlib.sha256(observation.tobytes())
    env.action_space.seed(seed)
    for _ in range(steps):
        observation, reward, *_ = env.step(env.action_space.sample())
        found.update(observation.tobytes() + reward.hex().encode())
    return found.hexdigest()


def make(name, backend):
    return gymnasium.make(f"physx/{name}-v0", backend=backend).unwrapped


if __name__ == "__main__":
    for each in ALL:
        print(run(make(*each), int(sys.argv[1])))
