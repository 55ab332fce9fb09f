"""Push a box to its goal with a scripted policy, and look at it: physx/PushBox-v0.

    python examples/push_box.py                             # 20 episodes
    python examples/push_box.py --episodes 5 --render push_box.rrd
    python examples/push_box.py --policy FOLDER             # of train_ppo.py --env physx/PushBox-v0

Prints how many episodes succeeded; exits with 1 if the policy failed in more than one of ten.
`--render` writes the last episode as a recording that Rerun opens.
"""

import argparse
import sys

import gymnasium
import numpy as np

from physx_gym import Policy

AWAY = 0.3  # m, from the middle of the box, at which the stick goes around it


def push(observation):
    """Return an action: go around the box, behind it, then push it towards the goal.

    Args:
        observation: Of the environment, shape (15,).
    """
    stick, speed, box, way = (observation[i : i + 2] for i in (0, 2, 4, 13))
    way = way / max(np.linalg.norm(way), 1e-9)
    aside = np.array([-way[1], way[0]])
    along, across = (stick - box) @ way, (stick - box) @ aside
    if along < -0.1 and abs(across) < 0.1:  # behind it: push, and stay in the middle
        target = box + 0.2 * way - 2.0 * across * aside
    elif along < -AWAY + 0.04:  # far enough behind: go to the middle
        target = box - AWAY * way
    elif abs(across) > AWAY - 0.03:  # at its side: go back
        target = box - (AWAY + 0.05) * way + across * aside
    else:  # in front of it: go to its side
        target = stick + AWAY * np.sign(across or 1.0) * aside
    return np.clip(6.0 * (target - stick) - speed, -1.0, 1.0).astype(np.float32)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--policy", metavar="FOLDER", help="a policy that train_ppo.py saved")
    parser.add_argument("--render", metavar="FILE", help="recording of the last episode: FILE.rrd")
    chosen = parser.parse_args()
    env = gymnasium.make("physx/PushBox-v0")
    policy = Policy(chosen.policy, env) if chosen.policy else push
    base = env.unwrapped
    successes = 0
    for episode in range(chosen.episodes):
        if chosen.render and episode == chosen.episodes - 1:
            base.stop()
            base.eval()  # what happens is recorded
        observation, _ = env.reset(seed=chosen.seed + episode)
        total, over = 0.0, False
        while not over:
            observation, reward, terminated, truncated, info = env.step(policy(observation))
            total, over = total + reward, terminated or truncated
        successes += info["is_success"]
        left = float(np.hypot(*observation[13:15]))
        word = "at the goal" if info["is_success"] else f"{100 * left:.0f} cm away"
        print(f"episode {episode:3d}: {int(base.num_steps):3d} steps, reward {total:7.1f}, {word}")
    print(f"{successes} of {chosen.episodes} episodes succeeded")
    if chosen.render:
        print(f"recorded {base.replay(path=chosen.render)}")
    env.close()
    return 0 if successes >= 0.9 * chosen.episodes else 1


if __name__ == "__main__":
    sys.exit(main())
