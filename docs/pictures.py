"""Draws the pictures of the documentation that show environments.

python docs/pictures.py    # writes environments.png and replay.png beside this file
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from PIL import Image

import physx_gym

NAMES = ("Cartpole", "Acrobot", "Ant", "Quadruped", "ArmReach", "PushBox")
COLUMNS = 3
FEET = ("FR_foot", "FL_foot", "RR_foot", "RL_foot")


def moved(name: str, steps: int, **options: Any) -> Any:
    """Return an environment in evaluation mode after some steps of a swinging action."""
    env: Any = gymnasium.make(f"physx/{name}-v0", **options).unwrapped
    env.eval()
    env.reset(seed=3)
    space = env.action_space
    for step in range(steps):
        if isinstance(space, gymnasium.spaces.Discrete):
            action: Any = step // 4 % space.n
        else:
            action = 0.3 * np.sin(0.3 * step + np.arange(space.shape[0]))
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            break
    return env


def picture(name: str, size: tuple[int, int]) -> np.ndarray:
    """Return a picture of an environment, shape (height, width, 3), uint8."""
    env = moved(name, 5, render_mode="rgb_array")
    env.viewer_kwargs["picture_size"] = size
    try:
        drawn: np.ndarray = env.render()
    finally:
        env.close()
    return drawn


def environments(path: Path, size: tuple[int, int] = (320, 240)) -> None:
    """Draw all environments, side by side."""
    tiles = [picture(name, size) for name in NAMES]
    rows = [np.hstack(tiles[first : first + COLUMNS]) for first in range(0, len(tiles), COLUMNS)]
    Image.fromarray(np.vstack(rows)).save(path, optimize=True)


def replay(path: Path, size: tuple[int, int] = (1500, 800)) -> None:
    """Draw the replay of a quadruped: its signals, contacts, a foot's way, and another motion."""
    from physx_rerun.viewer.headless import render_picture

    with tempfile.TemporaryDirectory() as folder:
        logs = []
        for steps in (40, 25):
            env = moved("Quadruped", steps)
            env.stop()
            logs.append(env.log_data)
            env.close()
        recording = Path(folder, "replay.rrd")
        physx_gym.replay(logs[0], ghosts=logs[1], trajectories=[FEET[0]], path=recording)
        render_picture(recording, path, size)


if __name__ == "__main__":
    here = Path(__file__).parent
    environments(here / "environments.png")
    replay(here / "replay.png")
    sys.exit(0)
