"""A quadruped that stands up and trots: a gait on top of a pipeline of blocks.

`environments/quadruped.toml` describes the environment: a Unitree A1 whose joints are driven by a
PD controller with a torque limit, 200 times a second, and an attitude filter that sees only the
inertial sensor. This script only sets joint targets, 50 times a second: legs swing in pairs and
lean against the tilt that the filter estimates. The gait was found on DART. It is compared with a
robot that only stands, and runs on Pinocchio, too, where it was never tried before.

    python examples/10_quadruped.py --picture quadruped.webp
"""

import math
import sys
from pathlib import Path

import numpy as np
from common import options

from physx_gym import load_pipeline

ROBOT = Path(__file__).parent / "environments" / "quadruped.toml"
STAND, LIFT = np.array([0.0, 0.75, -1.7]), np.array([0.0, 0.3, -0.6])  # rad: hip, thigh, calf
READY, STRIDE, SWEEP, LEAN = 2.0, 0.16, 0.3, 0.2  # s, s, rad, 1
PAIRS = np.array([0.0, 1.0, 1.0, 0.0])  # front left with rear right, front right with rear left
SIDES = np.array([1.0, -1.0, 1.0, -1.0])  # left and right


def targets(t, first, attitude, trots):
    """Return the joint targets at a time, shape (12,), in rad.

    `first` holds the initial joint positions, `attitude` the estimated roll, pitch and yaw, in rad.
    """
    share = min(1.0, 2.0 * t / READY)  # once up, it has as long again to settle
    legs = (1.0 - share) * first.reshape(4, 3) + share * STAND
    if trots and t > READY:  # each leg swings for one stride and pushes for the next
        effort, phase = min(1.0, t - READY), math.pi * ((t - READY) / STRIDE + PAIRS)
        legs += effort * np.fmax(np.sin(phase), 0.0)[:, None] * LIFT
        legs[:, 1] += effort * SWEEP * np.cos(phase) * (1.0 + SIDES * attitude[2])
    legs[:, :2] -= LEAN * attitude[:2]
    return legs.ravel()


def walk(env, seconds, trots=True):
    """Have the robot get up and walk; return x, y, z in m and the tilt in degrees of each step."""
    observation, _ = env.reset(seed=0)
    first, clock = observation["states"]["agent"]["q"][7:].copy(), env.stepper_state
    seen, over = [], False
    while not over and clock.t < READY + seconds:
        attitude = observation["features"]["attitude"]["roll_pitch_yaw"][:, 0]
        observation, _, _, over, _ = env.step(targets(clock.t, first, attitude, trots))
        x, y, z, a, b, *_ = observation["states"]["agent"]["q"]
        if clock.t > READY:
            seen.append((x, y, z, math.degrees(math.acos(max(-1.0, 1.0 - 2.0 * (a * a + b * b))))))
    return np.array(seen)


def main():
    chosen = options(__doc__).parse_args()
    seconds, forward = 4.0 if chosen.small else 20.0, {}
    print(f"{seconds:.0f} s of                 forward    aside   lowest trunk   most tilt")
    for name, trots in (("standing", False), ("trotting", True)):
        for backend in ("dart", "pinocchio"):
            env = load_pipeline(ROBOT)(backend=backend)
            x, y, z, tilt = walk(env, seconds, trots).T
            env.close()
            row = f"{x[-1]:9.2f} m{y[-1]:7.2f} m{z.min():13.2f} m{tilt.max():10.1f}°"
            print(f"{name} on {backend:9}{row}")
            forward[name, backend] = x[-1] if z.min() > 0.18 else -np.inf  # it fell
    if chosen.picture:
        env = load_pipeline(ROBOT)()
        env.eval()  # records the episode
        walk(env, 2.0)
        env.replay(record_video_path=chosen.picture, frame_rate=12.5, picture_size=(360, 220))
        env.close()
    return int(min(forward["trotting", each] for each in ("dart", "pinocchio")) < 0.5 * seconds)


if __name__ == "__main__":
    sys.exit(main())
