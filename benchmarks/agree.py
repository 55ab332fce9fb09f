"""Planted differences that `physx agree` names; three engines on every robot file installed.

    python benchmarks/agree.py [--check] [planted] [robots]

Planted: an engine simulates another world than it is asked to, or a task is a step late on it; the
difference must be among the confirmed causes, with its link or joint and its sign. Robots: mass
matrix, bias and forward dynamics of each pair of engines in random states, relative to the largest
value of the state.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
from measure import claim, finish

from physx_agree import Parting, agree
from physx_core import PhysxError, plugins
from physx_sim import Robot, Simulation, World, mjcf_robots
from physx_sim.engines import read_robot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from planted import BETWEEN, Stagger, late_on, planted, plants

ENGINES = ("dart", "pinocchio", "mujoco")
PAIRS = tuple(itertools.combinations(ENGINES, 2))
STEPS, STATES, NEGLIGIBLE = 150, 10, 1e-6
TASKS = (
    Stagger, "physx_gym:physx/Quadruped-v0", "physx_gym:physx/PushBox-v0",
    "physx_gym:physx/ArmReach-v0",
)  # fmt: skip


def parting(task: object, one: object, other: object) -> Parting:
    """Return where and why two engines part."""
    [found] = agree(task, [one, other], seeds=[0], steps=STEPS).partings
    return found


def is_named(name: str, one: str, other: str, folder: Path) -> bool:
    """Plant a difference on the second engine; return whether it is named, and print it."""
    if name == "delay":
        engine = planted(other, lambda world: world)
        found = parting(late_on(engine), one, engine)
        named = any("Late.delay: 0 | 1" in cause.text for cause in found.causes)
    else:
        plant = plants(folder)[name]
        found = parting(Stagger, one, planted(other, plant.change))
        named = plant.is_named_in(found.causes)
    print(
        f"  {one:9} | {other:9} {name:17} {'named' if named else 'MISSED':7}"
        f" {100 * found.unexplained:6.2f} % unexplained",
        flush=True,
    )
    return named


def check_planted(folder: Path) -> Iterator[bool]:
    """Plant differences, and nothing."""
    print("Planted differences")
    alone = [is_named(name, "dart", "dart", folder) for name in (*plants(folder), "delay")]
    yield claim("named on one engine, of 12", sum(alone), at_least=12)
    for one, other in PAIRS:
        found = [is_named(name, one, other, folder) for name in (*BETWEEN, "delay")]
        yield claim(f"named between {one} and {other}, of 9", sum(found), at_least=9)
    probed = [is_named("contact friction", *pair, folder) for pair in PAIRS]
    yield claim("friction of contacts named between engines, of 3", sum(probed), at_least=3)
    quiet = 0
    for task, engine in itertools.product(TASKS, ENGINES):
        found = parting(task, engine, planted(engine, lambda world: world))
        quiet += not (found.parted or found.causes)
    yield claim("nothing planted, no step above 10 x the floor, of 12", quiet, at_least=12)


def worlds() -> Iterator[tuple[str, str, World]]:
    """Yield each robot of the engines' catalog and of Gymnasium's MJCF files."""
    for info in plugins.resolve("backend", "pinocchio").robots():
        if not info.error:
            floats = read_robot(Robot(info.name)).bodies[0].mass > NEGLIGIBLE
            robot = Robot(info.name, fixed_base=not floats, collisions="none")
            yield "robots", info.name, World([robot])
    for path in sorted((Path(gymnasium.__file__).parent / "envs/mujoco/assets").glob("*.xml")):
        yield "MJCF models", path.stem, World(mjcf_robots(path, collisions="none"))


def errors(simulations: list[Simulation]) -> dict[str, float]:
    """Return the largest relative differences of any two engines."""
    rng, layout = np.random.default_rng(0), simulations[0].layout
    found = {"mass matrix": 0.0, "bias": 0.0, "forward dynamics": 0.0}
    joints = list(layout.position_index.values())
    for _ in range(STATES):
        q, zero = simulations[0].positions(), np.zeros(layout.nv)
        q[joints] = rng.uniform(-1, 1, len(joints))
        v, tau = rng.uniform(-1, 1, (2, layout.nv))
        for name, values in (
            ("mass matrix", [each.mass_matrix(q) for each in simulations]),
            ("bias", [each.inverse_dynamics(q, v, zero) for each in simulations]),
            ("forward dynamics", [each.forward_dynamics(q, v, tau) for each in simulations]),
        ):
            largest = max(float(np.abs(value).max()) for value in values) or 1.0
            for one, other in itertools.combinations(values, 2):
                found[name] = max(found[name], float(np.abs(one - other).max()) / largest)
    return found


def check_robots() -> Iterator[bool]:
    """Compare three engines on each robot."""
    worst: dict[tuple[str, str], tuple[float, str]] = {}
    counts: dict[str, int] = {}
    for kind, name, world in worlds():
        try:
            simulations = [plugins.resolve("backend", engine).build(world) for engine in ENGINES]
            found = errors(simulations)
        except PhysxError as error:
            print(f"  {name}: {str(error).splitlines()[0]}")
            continue
        for simulation in simulations:
            simulation.close()
        counts[kind] = counts.get(kind, 0) + 1
        for quantity, value in found.items():
            worst[kind, quantity] = max(worst.get((kind, quantity), (0.0, "")), (value, name))
    print("Three engines, largest relative difference of any two")
    for (kind, quantity), (value, name) in worst.items():
        what = f"{quantity}, {counts[kind]} {kind}, worst {name}"
        yield claim(what, value, at_most=1e-9)


def main() -> None:
    """Print the tables."""
    warnings.simplefilter("ignore")
    chosen = [each for each in ("planted", "robots") if each in sys.argv[1:]]
    met: list[bool] = []
    if not chosen or "planted" in chosen:
        with tempfile.TemporaryDirectory() as folder:
            met += check_planted(Path(folder))
    if not chosen or "robots" in chosen:
        met += check_robots()
    finish(met)


if __name__ == "__main__":
    main()
