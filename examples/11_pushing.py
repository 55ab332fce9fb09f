"""Pushing a box into a circle: a contact task solved by a rule of ten lines.

`physx/PushBox-v0` observes where the stick, the box and the circle are, and takes the acceleration
of the stick as its action. Pushing straight at the box loses it: the rule first goes around the box
and then stays in the middle of its back. It competes with doing nothing, random actions, and a
stick that runs straight at the box, all of them on both engines.

    python examples/11_pushing.py --picture push.webp
"""

import sys

import gymnasium
import numpy as np
from common import options

import physx_gym  # noqa: F401 - registers the environments
from physx_gym.cli.evaluate import evaluate, summary

AWAY = 0.3  # m, distance from the box's center at which the stick goes around it


def drive(observation, target):
    """Return the action that moves the stick toward a target."""
    action = 6.0 * (target - observation[0:2]) - observation[2:4]
    return np.clip(action, -1.0, 1.0).astype(np.float32)


def push(observation):
    """Go around the box to its back, then push it toward the circle.

    Args:
        observation: The environment's observation, shape (15,).
    """
    stick, box, way = (observation[i : i + 2] for i in (0, 4, 13))
    way = way / max(np.linalg.norm(way), 1e-9)
    aside = np.array([-way[1], way[0]])
    along, across = (stick - box) @ way, (stick - box) @ aside
    if along < -0.1 and abs(across) < 0.1:  # behind it: push, and stay in the middle
        return drive(observation, box + 0.2 * way - 2.0 * across * aside)
    if along < -AWAY + 0.04:  # far enough behind: go to the middle
        return drive(observation, box - AWAY * way)
    if abs(across) > AWAY - 0.03:  # at its side: go back
        return drive(observation, box - (AWAY + 0.05) * way + across * aside)
    return drive(observation, stick + AWAY * np.sign(across or 1.0) * aside)  # go to its side


def main():
    chosen = options(__doc__).parse_args()
    episodes, reached = range(4 if chosen.small else 40), {}
    print(f"boxes of {len(episodes)} in the circle       dart   pinocchio")
    for name in ("nothing", "chance", "straight at it", "rule"):
        for backend in ("dart", "pinocchio"):
            env = gymnasium.make("physx/PushBox-v0", backend=backend)
            env.action_space.seed(0)
            act = {
                "nothing": lambda _: np.zeros(2, np.float32),
                "chance": lambda _, space=env.action_space: space.sample(),
                "straight at it": lambda seen: drive(seen, seen[4:6]),
                "rule": push,
            }[name]
            found = summary(evaluate(env, act, episodes))["success"]["mean"]
            reached[name, backend] = round(found * len(episodes))
            env.close()
        print(f"{name:28}{reached[name, 'dart']:9}{reached[name, 'pinocchio']:12}", flush=True)
    if chosen.picture:
        base = gymnasium.make("physx/PushBox-v0").unwrapped
        base.evaluate(lambda seen, *_: push(seen), seed=4, enable_stats=False, enable_replay=False)
        base.replay(record_video_path=chosen.picture, frame_rate=10.0, picture_size=(360, 240))
        base.close()
    return int(reached["rule", "dart"] < 0.9 * len(episodes))


if __name__ == "__main__":
    sys.exit(main())
