"""A quadruped gets up from its knees, stands, and walks in place: a pipeline of blocks at work.

`pipeline.toml` describes the environment: a Unitree A1 whose joints are driven by a PD controller above a
limit of torques, 200 times a second, and an attitude filter that sees the inertial sensor alone. This
script only says, 50 times a second, where the joints shall be.

    pip install "physx-dart[robots]"
    python examples/quadruped/run.py                        # 20 s of walking
    python examples/quadruped/run.py --small                # 4 s
    python examples/quadruped/run.py --render quadruped.rrd # the same, as a recording for Rerun

It prints what the filter estimated beside what is true, and exits with 1 if the robot fell or its
feet stayed on the ground.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np

from physx_core.gym import load_pipeline

STAND = np.array([0.0, 0.8, -1.6])
GET_UP, SETTLE, STEP = 1.0, 1.0, 0.4  # s
LIFT = np.array([0.0, 0.3, -0.6])
PAIRS = np.array([0.0, 1.0, 1.0, 0.0])  # front left with rear right, front right with rear left


def targets(t, first, tilt, rates):
    """Return where the joints shall be, shape (12,), in rad.

    Args:
        t: Time, in s.
        first: Where they were at the beginning.
        tilt: Estimated roll and pitch, in rad.
        rates: Of roll and pitch, in rad/s.
    """
    share = min(1.0, t / GET_UP)
    legs = (1.0 - share) * first.reshape(4, 3) + share * STAND
    begin = GET_UP + SETTLE
    if t > begin:
        # A leg is in the air for one half of the period, as high as a half wave of a sine says.
        phase = math.pi * ((t - begin) / STEP + PAIRS)
        legs += np.fmax(np.sin(phase), 0.0)[:, None] * LIFT * min(1.0, t - begin)
    roll, pitch = tilt + 0.1 * rates
    legs[:, 0] -= 0.3 * roll
    legs[:, 1] -= 0.3 * pitch
    return legs.ravel()


def walk(env, seconds, seed):
    """Let the robot get up and walk; return what was seen."""
    observation, _ = env.reset(seed=seed)
    first = observation["states"]["agent"]["q"][7:].copy()
    clearance = env.simulator.simulation
    feet = [name for name in env.simulator.layout.bodies if name.endswith("_foot")]
    heights, drifts, errors, torques = [], [], [], []
    over = False
    while not over and env.stepper_state.t < GET_UP + SETTLE + seconds:
        features = observation["features"]["attitude"]
        tilt, rates = features["roll_pitch_yaw"][:2, 0], features["angular_velocity"][:2, 0]
        action = targets(env.stepper_state.t, first, tilt, rates)
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        q = observation["states"]["agent"]["q"]
        x, y, z, w = q[3:7]
        up = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))
        estimated = np.arccos(np.clip(np.cos(tilt[0]) * np.cos(tilt[1]), -1.0, 1.0))
        errors.append(abs(up - estimated))
        torques.append(np.abs(env.robot_state.command).max())
        if env.stepper_state.t > GET_UP + SETTLE:
            heights.append(q[2])
            drifts.append(clearance.body_poses(feet)[:, 2])
    return over, np.array(heights), np.array(drifts), np.array(errors), np.array(torques)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="walk for 4 s")
    parser.add_argument("--backend", default="dart")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--render", metavar="FILE", help="write a recording for Rerun")
    chosen = parser.parse_args()
    env = load_pipeline(Path(__file__).with_name("pipeline.toml"))()
    over, heights, feet, errors, torques = walk(env, 4.0 if chosen.small else 20.0, chosen.seed)
    print(over, heights.min(), heights.max(), feet.max(0)-feet.min(0), errors.max(), torques.max(), env.robot_state.q[:7])


if __name__ == "__main__":
    sys.exit(main())
