"""A room in another process, driven as a Godot application would be: find the apples.

1. `physx serve room.py:AppleSeeker --protocol godot-gym` runs the room on DART in another process.
2. `connect` makes a Gymnasium environment of it: what it observes and takes, the room tells.
3. A policy of a few lines drives to the apples that it sees, and away from walls.

Prints the apples found in each episode. Ends with status 1 if there were none.

    python examples/apple_seeker/run.py
    python examples/apple_seeker/run.py --small     # some seconds
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from physx_remote import connect

ROOM = Path(__file__).with_name("room.py")


def policy(seen: dict[str, np.ndarray], rng: np.random.Generator) -> np.ndarray:
    """Return the speeds of both wheels: towards the nearest apple, and never into a wall."""
    obstacles, apples = seen["obstacles"], seen["apples"]
    rays = len(apples)
    front = np.array([0, 1, -1, 2, -2])
    nearest = int(front[obstacles[front].argmin()])
    goal = int(apples.argmin())
    if obstacles[nearest] < min(0.6, apples[goal]):  # back off, and turn away from it
        turn = -0.6 if nearest > 0 else 0.6
        return np.array([-0.3 - turn, -0.3 + turn], np.float32)
    if apples[goal] >= 6.0:
        goal = int(rng.choice([0, 0, 0, 0, 1, -1, 2]))
    angle = (goal + rays // 2) % rays - rays // 2
    turn = np.clip(4 * angle / rays, -0.5, 0.5)
    ahead = max(0.0, 1 - 6 * abs(angle) / rays)
    return np.clip([ahead - turn, ahead + turn], -1, 1).astype(np.float32)


def main() -> int:
    """Drive; the exit status says whether any apple was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="some seconds")
    options = parser.parse_args()
    episodes, steps = (1, 200) if options.small else (5, 1000)
    words = ["serve", f"{ROOM}:AppleSeeker", "--protocol", "godot-gym", "--port", "0"]
    server = subprocess.Popen(
        [sys.executable, "-m", "physx_core.cli", *words], stdout=subprocess.PIPE, text=True
    )
    found, taken, begin = 0, 0, time.perf_counter()
    try:
        line = next((text for text in server.stdout if "listening at" in text), "")
        address = line.split()[-1]
        with connect(address, "godot-gym", repeat_action=6) as room:
            rng = np.random.default_rng(0)
            for episode in range(episodes):
                seen, info = room.reset(seed=episode)
                before, step, over = info["left"], 0, False
                while step < steps and not over:
                    seen, reward, over, _, info = room.step(policy(seen, rng))
                    found, step = found + int(reward), step + 1
                taken += step
                count = before - info["left"]
                print(f"episode {episode}: {count} of {before} apples, {step} steps")
    finally:
        server.terminate()
        server.wait()
    seconds = time.perf_counter() - begin
    print(f"{found} apples in {taken} steps; all of it took {seconds:.1f} s")
    return int(found == 0)


if __name__ == "__main__":
    raise SystemExit(main())
