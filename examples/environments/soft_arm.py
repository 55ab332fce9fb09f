"""A compliant arm with two links: what it does follows from the torques that were planned."""

import numpy as np
from matplotlib.figure import Figure

from physx_gym import RobotEnv
from physx_sim import Encoder, JointSettings, Motor, Robot, World

SECONDS, STEP, PERIOD, KNOTS = 1.2, 0.02, 0.005, 6
TARGET = np.array([1.8, -0.9])  # rad
GAINS = np.array([[6.0, 2.0], [0.6, 0.2]])  # N m/rad, N m s/rad
MOST = np.array([16.0, 6.0])  # N m
KNOWN = Robot("double_pendulum", "arm")
HIDDEN = Robot(
    "double_pendulum",
    "arm",
    mass_factors={"upper": 1.15, "lower": 0.85},
    joints={
        "shoulder": JointSettings(damping=0.5, friction=0.8),
        "elbow": JointSettings(damping=0.2, friction=0.3),
    },
)
LATE = 0.005  # s: by which the real arm's log has its torques too late


def tip(q):
    """Return where the tip is, in m, shape (..., 2)."""
    upper, lower = q[..., 0], q[..., 0] + q[..., 1]
    return 0.5 * np.stack([np.sin(upper) + np.sin(lower), -np.cos(upper) - np.cos(lower)], axis=-1)


class SoftArm(RobotEnv):
    """Reach a target within a second, from about where it hangs."""

    def __init__(self, robot=KNOWN, step=STEP, **options):
        joints = ("shoulder", "elbow")
        motors = [Motor(joint=j, max_torque=m) for j, m in zip(joints, MOST, strict=True)]
        sensors = [Encoder(name=joint, joint=joint, noise=1e-4) for joint in joints]
        world = World([robot], contacts="none", period=PERIOD)
        super().__init__(world, step, motors=motors, sensors=sensors, **options)

    def _sample_state(self):
        return self.np_random.uniform(-0.02, 0.02, 2), np.zeros(2)


def reach(env, plan, seed, path=None):
    """Follow a plan of torques (2, knots) with soft feedback; return the miss, in m.

    It is the mean distance of the tip from the target in the last fifth of the time. The list
    `path` gets the places of the tip.
    """
    env.reset(seed=seed)
    steps, places = round(SECONDS / STEP), [] if path is None else path
    times = np.linspace(0, 1, plan.shape[1])
    wanted = np.array([np.interp(np.arange(steps) / steps, times, each) for each in plan]).T
    for torque in wanted:
        q, v = env.robot_state.q, env.robot_state.v
        env.step(np.clip(torque + GAINS[0] * (TARGET - q) - GAINS[1] * v, -MOST, MOST))
        places.append(tip(env.robot_state.q))
    last = np.array(places[-(steps // 5) :])
    return float(np.linalg.norm(last - tip(TARGET), axis=1).mean())


def write_log(path, env, seconds):
    """Let an arm follow sums of sines; log encoders and noisy torques, the latter `LATE`."""
    env.reset(seed=0)
    random, rows, queue = np.random.default_rng(0), [], [np.zeros(2)] * round(LATE / PERIOD)
    for step in range(round(seconds / PERIOD)):
        time = PERIOD * step
        wave = [np.sin(2 * time) + 0.4 * np.sin(7 * time), np.sin(3 * time + 1) - 0.8]
        q, v = env.robot_state.q, env.robot_state.v
        torque = [30, 8] * (min(1.0, time) * np.array(wave) - q) - [3, 0.4] * v
        queue.append(np.clip(torque, -MOST, MOST))
        angles = env.measurements["measurements"]["Encoder"][0]
        rows.append([time, *angles, *(queue.pop(0) + random.normal(size=2) * [0.3, 0.1])])
        env.step(queue[-1])
    names = "time [s],q.shoulder,q.elbow,tau.shoulder,tau.elbow"
    np.savetxt(path, rows[200:], delimiter=",", header=names, comments="")


def draw(path, env, plans):
    """Draw the paths of the tip that plans lead to on an arm."""
    figure = Figure(figsize=(5.0, 3.4), layout="constrained")
    axes = figure.subplots()
    for name, plan in plans.items():
        for seed in range(5):
            places = []
            reach(env, plan, seed, places)
            label = name if not seed else None
            color = f"C{list(plans).index(name)}"
            axes.plot(*np.array(places).T, color=color, alpha=0.7, lw=1, label=label)
    axes.plot(*tip(TARGET), "k+", ms=12, label="target")
    axes.set(xlabel="x [m]", ylabel="z [m]", aspect="equal", title="Tip of the real arm")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)
