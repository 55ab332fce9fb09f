"""A room in another process, driven like a Godot application: find the apples.

`physx serve` runs the room on DART; this process connects and gets a Gymnasium environment whose
observations and actions the room defines. A policy of a few lines drives to the apples that the
robot sees, through gaps that are wide enough. Its rival is the same policy, blind to apples.

    python examples/13_remote_world.py --picture room.webp
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
from common import options
from environments.room_film import Film

from physx_remote import connect

FAR = 6.0  # reading of rays that hit nothing, in m


def policy(seen: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return the speeds of both wheels: toward the nearest apple, or toward free space."""
    obstacles, apples = seen["obstacles"], seen["apples"]
    rays, goal = len(obstacles), int(apples.argmin())
    if obstacles[[0, 1, -1]].min() < 0.55 and apples[goal] > 0.6:  # back off, and turn away from it
        turn = -0.3 if obstacles[1:4].min() < obstacles[-3:].min() else 0.3
        return np.array([-0.4 - turn, -0.4 + turn], np.float32)
    turns = (np.arange(rays) + rays // 2) % rays - rays // 2  # of each ray, in rays from ahead
    room = np.min([np.roll(obstacles, shift) for shift in (-1, 0, 1)], axis=0)
    if apples[goal] < FAR:
        away = np.abs((turns - turns[goal] + rays // 2) % rays - rays // 2)
        cost = away + rays * (room < min(0.9, apples[goal]))
    else:
        cost = np.abs(turns) - 2.0 * np.minimum(room, 3.0) + rng.uniform(0, 1, rays)
    angle = int(turns[cost.argmin()])
    turn = np.clip(4 * angle / rays, -0.5, 0.5)
    ahead = max(0.0, 1 - 6 * abs(angle) / rays) * min(1.0, obstacles[0])
    return np.clip([ahead - turn, ahead + turn], -1, 1).astype(np.float32)


def drive(address: str, steps: int, seed: int, sees_apples: bool) -> list[dict]:
    """Drive until no apple is left, for at most `steps` steps; return the info of each step."""
    with connect(address, "godot-gym", repeat_action=6) as room:
        seen, info = room.reset(seed=seed)
        rng, scenes, over = np.random.default_rng(seed), [info], False
        while len(scenes) <= steps and not over:
            if not sees_apples:
                seen["apples"][:] = FAR
            seen, _, over, _, info = room.step(policy(seen, rng))
            scenes.append(info)
    return scenes


def main() -> int:
    """Drive through several rooms; return whether the blind policy is as quick."""
    chosen, quick = options(__doc__).parse_args(), []
    rooms, steps = (1, 60) if chosen.small else (5, 500)
    words = ["serve", "environments.room:AppleSeeker", "--protocol", "godot-gym", "--port", "0"]
    command, folder = [sys.executable, "-m", "physx_core.cli", *words], Path(__file__).parent
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as server:
        address = next(line for line in server.stdout if "listening at" in line).split()[-1]
        for name, sees in (("blind to apples", False), ("sees apples", True)):
            driven = [drive(address, steps, seed, sees) for seed in range(rooms)]
            found, taken = zip(*((s[-1]["eaten"].sum(), len(s) - 1) for s in driven), strict=True)
            quick.append(sum(taken) / max(sum(found), 1))
            print(f"{name:15}  apples: {', '.join(map(str, found))} of 5;", end="  ")
            print(f"steps: {', '.join(map(str, taken))};  {quick[-1]:.0f} for an apple")
        server.terminate()
    if chosen.picture:
        Film(driven[0]).save(chosen.picture, every=2)
    return int(quick[1] >= quick[0] and not chosen.small)


if __name__ == "__main__":
    raise SystemExit(main())
