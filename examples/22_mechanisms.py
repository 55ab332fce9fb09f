"""Mechanisms that no tree of joints describes: a four-bar linkage and coupled fingers.

The linkage is a chain that `attach` closes with a `Connect`, as a pin does; then its rocker has to
be where geometry says. The gripper has one motor: its right finger follows the left one (`<mimic>`
in its file), so they hold the box between them. The rivals are the same mechanisms without the pin
and without the coupling, on three engines.

    python examples/22_mechanisms.py --picture mechanisms.webp
"""

import sys

import numpy as np
from common import options
from environments.film import Scene, save
from environments.mechanisms import FRONT, LOOP, SIDE, four_bar, gripper, theory, trace

from physx_core import plugins

ENGINES, SPEED, TURN = ("dart", "pinocchio", "mujoco"), np.pi, 4.0  # rad/s of the crank; s
MOVES = (0.4, 0.0, 0.0), (0.6, 0.0, 15.0), (2.0, 0.2, 15.0), (1.0, 0.0, 15.0)  # s, m, N


def turn(engine, closed, film=None):
    """Turn the crank of the linkage; return how far its rocker is from theory, in mrad."""
    world, errors = four_bar(), []
    with plugins.resolve("backend", engine).build(world) as simulation:
        simulation.set_state(theory(0.5), np.zeros(3))
        if closed:
            simulation.attach(LOOP)
        simulation.set_commands([SPEED, 0.0, 0.0])
        scene = film is not None and Scene(simulation, world, "Linkage", **FRONT)
        for _ in range(round(TURN / 0.1)):
            simulation.step(50)
            crank, _, rocker = simulation.positions()
            errors.append(abs(np.angle(np.exp(1j * (rocker - theory(crank)[2])))))
            if scene:
                trace(scene)
                scene.add()
    return 1e3 * max(errors) if film is None else film.append(scene)


def lift(engine, coupled, film=None):
    """Close the gripper, lift and lower it; return how high it lifts the box, in mm."""
    world, heights = gripper(coupled), []
    with plugins.resolve("backend", engine).build(world) as simulation:
        scene = film is not None and Scene(simulation, world, "Gripper", **SIDE)
        for seconds, height, force in MOVES:
            simulation.set_commands([height, force, 0.0])
            for _ in range(round(seconds / 0.1)):
                simulation.step(50)
                heights.append(simulation.body_poses(["box"])[0, 2])
                if scene:
                    scene.add()
    return 1e3 * (max(heights) - heights[0]) if film is None else film.append(scene)


def main():
    chosen, film, found = options(__doc__).parse_args(), [], {}
    print(f"{'of 4 s':32}" + "".join(f"{engine:>11}" for engine in ENGINES))
    for name, task, works in (
        ("rocker off theory, mrad, no pin", turn, False),
        ("rocker off theory, mrad", turn, True),
        ("box lifted, mm, not coupled", lift, False),
        ("box lifted, mm", lift, True),
    ):
        found[name] = [task(engine, works) for engine in ENGINES]
        print(f"{name:32}" + "".join(f"{each:11.2f}" for each in found[name]), flush=True)
    if chosen.picture:
        turn("dart", True, film)
        lift("dart", True, film)
        save(chosen.picture, film, (320, 260))
    return int(max(found["rocker off theory, mrad"]) > 1 or min(found["box lifted, mm"]) < 180)


if __name__ == "__main__":
    sys.exit(main())
