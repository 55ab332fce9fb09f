"""A quadruped gets up from its knees, stands, and walks in place: a pipeline of blocks at work.

`pipeline.toml` describes the environment: a Unitree A1 whose joints are driven by a PD controller
above a limit of torques, 200 times a second, and an attitude filter that sees the inertial sensor
alone. This script only says, 50 times a second, where the joints shall be.

    pip install "./physx_dart[robots]"
    python examples/quadruped/run.py                        # 20 s of walking
    python examples/quadruped/run.py --small                # 4 s
    python examples/quadruped/run.py --render quadruped.rrd # the same, and a recording for Rerun

It prints what was seen, and exits with 1 if the robot fell or a foot stayed on the ground.
"""

import argparse
import math
import sys
from pathlib import Path

import numpy as np

from physx_gym import load_pipeline

STAND = np.array([0.0, 0.9, -1.6])
LIFT = np.array([0.0, 0.3, -0.6])
GET_UP, SETTLE, STRIDE = 1.0, 1.0, 0.2  # s
PAIRS = np.array([0.0, 1.0, 1.0, 0.0])  # front left with rear right, front right with rear left
LEAN = 0.1
FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")


def targets(t, first, tilt):
    """Return where the joints shall be, shape (12,), in rad.

    Args:
        t: Time, in s.
        first: Where they were at the beginning, shape (12,), in rad.
        tilt: Estimated roll and pitch, in rad.
    """
    share = min(1.0, t / GET_UP)
    legs = (1.0 - share) * first.reshape(4, 3) + share * STAND
    walking = t - GET_UP - SETTLE
    if walking > 0:
        # A leg is lifted for one stride and stands for the next one.
        phase = math.pi * (walking / STRIDE + PAIRS)
        legs += min(1.0, walking) * np.fmax(np.sin(phase), 0.0)[:, None] * LIFT
    legs[:, :2] -= LEAN * tilt
    return legs.ravel()


def walk(env, seconds, seed):
    """Let the robot get up and walk; return by name what was seen in each step of walking."""
    observation, _ = env.reset(seed=seed)
    first = observation["states"]["agent"]["q"][7:].copy()
    clock, simulation = env.stepper_state, env.simulator.simulation
    seen = {"time": [], "height": [], "feet": [], "tilt": [], "estimated tilt": []}
    truncated = False
    while not truncated and clock.t < GET_UP + SETTLE + seconds:
        roll, pitch, _ = observation["features"]["attitude"]["roll_pitch_yaw"][:, 0]
        observation, _, _, truncated, _ = env.step(targets(clock.t, first, np.array([roll, pitch])))
        roll, pitch, _ = observation["features"]["attitude"]["roll_pitch_yaw"][:, 0]
        x, y, z, *_ = q = observation["states"]["agent"]["q"]
        seen["time"].append(clock.t)
        seen["height"].append(z)
        seen["feet"].append(simulation.body_poses(FEET)[:, 2])
        seen["tilt"].append(math.acos(max(-1.0, 1.0 - 2.0 * float(q[3] ** 2 + q[4] ** 2))))
        seen["estimated tilt"].append(math.acos(math.cos(roll) * math.cos(pitch)))
    walked = np.array(seen["time"]) > GET_UP + SETTLE
    return {name: np.array(values)[walked] for name, values in seen.items()} | {"place": (x, y)}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="walk for 4 s only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--render", metavar="FILE", help="write a recording for Rerun: FILE.rrd")
    chosen = parser.parse_args()
    env = load_pipeline(Path(__file__).with_name("pipeline.toml"))()
    if chosen.render:
        env.eval()
    seconds = 4.0 if chosen.small else 20.0
    seen = walk(env, seconds, chosen.seed)
    lift = np.ptp(seen["feet"], axis=0)
    wrong = np.abs(seen["tilt"] - seen["estimated tilt"])
    print(f"walked for {len(seen['time']) * env.step_dt:.1f} s of {seconds:.1f} s")
    print(f"  height of the trunk   {seen['height'].min():.3f} to {seen['height'].max():.3f} m")
    print(f"  lift of the feet      {', '.join(f'{100 * each:.0f}' for each in lift)} cm")
    print(
        f"  where it ended        {seen['place'][0]:.2f}, {seen['place'][1]:.2f} m from its start"
    )
    print(f"  tilt                  at most {math.degrees(seen['tilt'].max()):.1f} degrees")
    print(f"  error of the filter   at most {math.degrees(wrong.max()):.1f} degrees")
    if chosen.render:
        print(f"recorded {env.replay(path=chosen.render)}")
    env.close()
    whole = len(seen["time"]) * env.step_dt > seconds - 2 * env.step_dt
    stands = whole and seen["height"].min() > 0.2 and lift.min() > 0.02
    print("walked in place" if stands else "fell, or did not walk")
    return 0 if stands else 1


if __name__ == "__main__":
    sys.exit(main())
