"""A robot that finds its way through a garden of posts with a lidar.

Forty-one rays tell how far away things are. Of the directions in which a corridor as wide as the
robot is free, it takes the one nearest to the goal, and slows down where the corridor is short. The
rival runs straight at the goal. The rays are cast by physx, so each engine's robot sees the same.

    python examples/23_lidar.py --picture lidar.webp
"""

import sys

import numpy as np
from common import options
from environments.film import Scene, save
from environments.garden import GOAL, REACH, TURNS, VIEW, bearing, drive, garden, lidar, rays

from physx_core import plugins
from physx_sim import Sensors

ENGINES, WIDTH, SECONDS = ("dart", "pinocchio", "mujoco"), 0.36, 16.0  # m, half the corridor; s


def corridors(distances):
    """Return how far the robot can go along each ray before its corridor meets something, in m."""
    x, y = distances * np.cos(TURNS), distances * np.sin(TURNS)
    seen, free = distances < REACH, np.full(len(TURNS), REACH)
    for ray, angle in enumerate(TURNS):
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        met = seen & (np.abs(across) < WIDTH) & (along > 0)
        free[ray] = np.min(along[met], initial=REACH)
    return free


def steer(distances, away, goal):
    """Return speed in m/s and turn in rad/s; the goal is `away`, in the direction `goal`."""
    free = corridors(distances)
    best = np.argmax(np.minimum(free, min(away, 2.0)) - 0.6 * np.abs(TURNS - goal - 0.2))
    return 0.6 * min(1.0, free[len(TURNS) // 2]), 2.0 * TURNS[best]


def travel(engine, number, sees=True, picture=None):
    """Drive through a garden; return how far from the goal the robot ends, in m."""
    world = garden(number)
    with plugins.resolve("backend", engine).build(world) as simulation:
        sensors, film = Sensors(simulation, world, [lidar()]), []
        while simulation.time < SECONDS and bearing(simulation)[0] > 0.3:
            sensors.update(simulation)
            seen, goal = sensors["lidar"]["distances"], bearing(simulation)
            drive(simulation, *(steer(seen, *goal) if sees else (0.6, 2.0 * goal[1])))
            if picture and not film:
                film.append(Scene(simulation, world, "Lidar", **VIEW))
                look = {"color": "#ff5a4d", "size": 0.004}
                film[0].factory.add_lines("rays", list(rays(simulation, seen)), **look)
                film[0].factory.add_symbols("goal", [(*GOAL, 0.02)], symbol="star", size=0.25)
            elif picture and round(simulation.time / 0.05) % 6 == 0:
                film[0].factory.update_lines("rays", positions=list(rays(simulation, seen)))
                film[0].add()
            simulation.step(10)
        if picture:
            save(picture, film, (440, 300), 1 / 0.3)
        return bearing(simulation)[0]


def main():
    chosen = options(__doc__).parse_args()
    gardens, found = range(1 if chosen.small else 2), {}
    print(f"{f'of {len(gardens)} goals reached':24}" + "".join(f"{name:>11}" for name in ENGINES))
    for name, sees in (("straight ahead", False), ("with lidar", True)):
        ends = [[travel(engine, number, sees) for number in gardens] for engine in ENGINES]
        found[name] = [sum(end < 0.3 for end in each) for each in ends]
        print(f"{name:24}" + "".join(f"{each:11}" for each in found[name]), flush=True)
    if chosen.picture:
        travel("dart", 0, picture=chosen.picture)
    return int(found["with lidar"] != [len(gardens)] * len(ENGINES))


if __name__ == "__main__":
    sys.exit(main())
