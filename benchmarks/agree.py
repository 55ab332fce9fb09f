"""Planted differences that `physx agree` names; three engines on every robot file installed.

    python benchmarks/agree.py [--check] [planted] [robots] [models]

Planted: an engine simulates another world than it is asked to, or a task is a step late on it; the
difference must be among the confirmed causes, with its link or joint and its sign. Robots: mass
matrix, bias and forward dynamics of each pair of engines in random states, relative to the largest
value of the state. Models: the same of MJCF files, of which MuJoCo's own reader and simulation make
a fourth, which knows nothing of physx: Gymnasium's, and those of dm_control and robosuite, if they
are installed (`pip install --no-deps -r benchmarks/requirements-mjcf.txt`).
"""

from __future__ import annotations

import importlib.util
import itertools
import re
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from measure import claim, finish

from physx_agree import Parting, agree
from physx_core import PhysxError, plugins
from physx_sim import Robot, Simulation, World, mjcf_robots
from physx_sim.engines import read_robot

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from compiled import Compiled, states, without_friction
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


def robots() -> Iterator[tuple[str, list[Robot]]]:
    """Yield each robot of the engines' catalog."""
    for info in plugins.resolve("backend", "pinocchio").robots():
        if not info.error:
            floats = read_robot(Robot(info.name)).bodies[0].mass > NEGLIGIBLE
            yield info.name, [Robot(info.name, fixed_base=not floats, collisions="none")]


FILES = {
    "gymnasium": ("envs/mujoco/assets/*.xml",),
    "dm_control": (
        "suite/*.xml", "locomotion/walkers/assets/*.xml", "locomotion/walkers/assets/*/*.xml",
        "third_party/*/*.xml",
    ),
    "robosuite": ("models/assets/robots/*/robot.xml", "models/assets/grippers/*.xml"),
}  # fmt: skip
"""Where packages keep MJCF files."""


def models() -> Iterator[tuple[str, Path]]:
    """Yield each MJCF file of the installed packages."""
    for package, patterns in FILES.items():
        found = importlib.util.find_spec(package)
        if found is None or found.origin is None:
            print(f"  {package} is not installed: none of its files")
            continue
        folder = Path(found.origin).parent
        for path in sorted(path for pattern in patterns for path in folder.glob(pattern)):
            yield f"{package}/{path.relative_to(folder)}", path


def errors(simulations: list[Simulation], theirs: Compiled | None = None) -> dict[str, float]:
    """Return the largest relative differences of any two engines, and of any from MuJoCo's own."""
    rng, layout = np.random.default_rng(0), simulations[0].layout
    found: dict[str, float] = {}
    ours = list(layout.velocity_index.values())
    for _ in range(STATES):
        q, v, tau = states(layout, rng)
        masses = [each.mass_matrix(q) for each in simulations]
        biases = [each.inverse_dynamics(q, v, np.zeros(layout.nv)) for each in simulations]
        motions = [each.forward_dynamics(q, v, tau) for each in simulations]
        pairs = [
            *(("mass matrix", *pair) for pair in itertools.combinations(masses, 2)),
            *(("bias", *pair) for pair in itertools.combinations(biases, 2)),
            *(("forward dynamics", *pair) for pair in itertools.combinations(motions, 2)),
        ]
        if theirs is not None:
            other = theirs.accelerations(q, v, tau)
            pairs += [("forward dynamics, MuJoCo's own", each, other) for each in motions]
            joints = np.ix_(ours, ours)
            pairs += [
                ("mass matrix, MuJoCo's own", each[joints], theirs.masses()) for each in masses
            ]
        for what, one, other in pairs:
            largest = float(np.abs(one).max()) or 1.0
            found[what] = max(found.get(what, 0.0), float(np.abs(one - other).max()) / largest)
    return found


def check_robots() -> Iterator[bool]:
    """Compare three engines on each robot."""
    yield from compared("robots", robots(), own=False)


def check_models() -> Iterator[bool]:
    """Compare three engines, and MuJoCo's own reader, on each MJCF file."""
    yield from compared("MJCF models", readable(), own=True)


def readable() -> Iterator[tuple[str, list[Robot]]]:
    """Yield the robots of each file; those that are no model of their own are named."""
    for name, path in models():
        try:
            yield name, without_friction(mjcf_robots(path, collisions="none"))
        except PhysxError as error:
            print(f"  {name}: {said(error)}")


def said(error: PhysxError) -> str:
    """Return an error in a line, with packages in the place of folders."""
    return re.sub(rf"\S*/(?={'|'.join(FILES)})", "", " ".join(str(error).split()))


def compared(kind: str, given: Iterator[tuple[str, list[Robot]]], *, own: bool) -> Iterator[bool]:
    """Compare three engines on each of several robots, and with MuJoCo's own reader."""
    worst: dict[str, tuple[float, str]] = {}
    count = 0
    for name, each in given:
        try:
            simulations = [
                plugins.resolve("backend", engine).build(World(each)) for engine in ENGINES
            ]
        except PhysxError as error:
            print(f"  {name}: {said(error)}")
            continue
        theirs = Compiled(Path(each[0].urdf), simulations[0].layout) if own else None
        for what, value in errors(simulations, theirs).items():
            worst[what] = max(worst.get(what, (0.0, "")), (value, name))
        for simulation in simulations:
            simulation.close()
        count += 1
    print("Three engines, largest relative difference of any two")
    for what, (value, name) in worst.items():
        yield claim(f"{what}, {count} {kind}, worst {name}", value, at_most=1e-9)
    if own:
        yield claim("MJCF models", count, at_least=25)


def main() -> None:
    """Print the tables."""
    warnings.simplefilter("ignore")
    chosen = [each for each in ("planted", "robots", "models") if each in sys.argv[1:]]
    met: list[bool] = []
    if not chosen or "planted" in chosen:
        with tempfile.TemporaryDirectory() as folder:
            met += check_planted(Path(folder))
    if not chosen or "robots" in chosen:
        met += check_robots()
    if not chosen or "models" in chosen:
        met += check_models()
    finish(met)


if __name__ == "__main__":
    main()
