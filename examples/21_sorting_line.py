"""A sorting line: conveyors, a suction cup, and crates that come and go while the world runs.

Crates ride on a belt (`surface_velocity`). When a red one is below the gantry, the belt stops, the
cup takes the crate (`attach` with a `Weld`) and releases it over the second belt. Crates wait
`hidden` for their turn. Three engines run the line; its rival is the gantry without suction.

    python examples/21_sorting_line.py --picture line.webp
"""

import sys

from common import options
from environments.film import Scene, save
from environments.sorting_line import COLORS, VIEW, drive, enter, line, sorted_crates

from physx_core import plugins
from physx_sim import BodySettings, Weld

SPEED, LAST, ENGINES = 0.5, 3.0, ("dart", "pinocchio", "mujoco")  # m/s; s at the end
HOME, LOW, OVER = (0.0, 0.1), (0.0, 0.35), (0.5, 0.1)  # m, places of the gantry: across, down


def take(simulation, crate, suction, scene):
    """Bring a crate from the first belt to the second one."""
    drive(simulation, "first", 0.0)
    for place, seconds in ((LOW, 0.3), (HOME, 0.25), (OVER, 0.8)):
        if place == HOME and suction:
            number = simulation.attach(Weld("cup", crate))
        simulation.set_commands(place)
        run(simulation, seconds, scene)
    if suction:
        simulation.detach(number)
    simulation.set_commands(HOME)
    drive(simulation, "first", SPEED)


def run(simulation, seconds, scene):
    for _ in range(round(seconds / 0.01)):
        simulation.step(2)
        if scene and simulation.frame % 24 == 0:
            scene.add()


def sort(engine, crates, suction=True, picture=None):
    """Run the line; return how many crates left it on the belt of their color."""
    world, names = line(crates)
    with plugins.resolve("backend", engine).build(world) as simulation:
        scene = picture and Scene(simulation, world, "Sorting line", **VIEW, colors=COLORS)
        for name in names:
            simulation.set_body(name, BodySettings(hidden=True))
        drive(simulation, "first", SPEED)
        drive(simulation, "second", -SPEED)
        simulation.set_commands(HOME)
        for name in names:
            enter(simulation, name)
            while simulation.body_poses([name])[0, 0] < 0.2:
                run(simulation, 0.01, scene)
            if name.startswith("red"):
                take(simulation, name, suction, scene)
        run(simulation, LAST, scene)
        if picture:
            save(picture, [scene], (440, 300))
        return sorted_crates(simulation, names)


def main():
    chosen = options(__doc__).parse_args()
    crates, found = 2 if chosen.small else 4, {}
    print(f"{f'of {crates} crates':20}" + "".join(f"{engine:>11}" for engine in ENGINES))
    for name, suction in (("without suction", False), ("with suction", True)):
        found[name] = [sort(engine, crates, suction) for engine in ENGINES]
        print(f"{name:20}" + "".join(f"{each:11}" for each in found[name]), flush=True)
    if chosen.picture:
        sort("mujoco", 4, picture=chosen.picture)
    return int(found["with suction"] != [crates] * len(ENGINES))


if __name__ == "__main__":
    sys.exit(main())
