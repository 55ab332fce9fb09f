"""An ant with noisy sensors: what comes of a seed, in this process or as a program."""

import sys

from physx_gym import RobotEnv
from physx_sim import Encoder, Imu


def make(backend):
    noisy = {"noise": 1e-2, "bias_deviation": 0.1, "random_walk": 0.1, "delay": 0.004}
    sensors = [Encoder(name="knee", joint="front_left_knee", **noisy, jitter=0.004)]
    sensors += [Imu(name="imu", body="torso", noise=0.1, period=0.01)]
    options = {"fixed_base": False, "period": 2e-3, "control_period": 0.01, "sensors": sensors}
    return RobotEnv("ant", 0.02, backend=backend, **options)


def run(env, seed, steps=3):
    found = [env.reset(seed=seed)[0]]
    env.action_space.seed(1)
    for _ in range(steps):
        found.append(env.step(env.action_space.sample())[0])
    measured = [each["measurements"] for each in found]
    states = [each["states"]["agent"] for each in found]
    arrays = [each[key] for each in (*measured, *states) for key in sorted(each)]
    return b"".join(array.tobytes() for array in arrays).hex()


if __name__ == "__main__":
    print(run(make(sys.argv[1]), 7))
