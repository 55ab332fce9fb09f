"""Contacts and free motion of all engines against theory, and the time of a step with each solver.

    python benchmarks/physics.py             # the figures of docs/contacts.md
    python benchmarks/physics.py --check     # exits with 1 if a default misses a target

Errors are relative to Coulomb's law with the true normal force, in steps of 1 ms; for thresholds,
the middle of the bracketing interval counts. Times are CPU times of a physics step, medians of
interleaved runs.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
from measure import claim, finish, rates, report
from truth import GRAVITY, table, threshold

import physx_gym  # noqa: F401 - registers the environments
from physx_core import plugins
from physx_sim import Box, Ground, Robot, Simulation, World, Wrench

SOLVERS = {"dart": ("nsgs", "fbf", "dantzig"), "pinocchio": ("pgs",), "mujoco": ("newton",)}
PAIRS = [(engine, solver) for engine, solvers in SOLVERS.items() for solver in solvers]
ANGLES = (0, 15, 30, 45)
FRICTION = 0.3
"""Friction of the feet of the pushed A1."""
WORST = {"dart": 0.01, "pinocchio": 0.01, "mujoco": 0.02}
"""Largest error of friction. MuJoCo's soft contacts creep before they slip."""
STAND = np.tile([0.0, 0.8, -1.6], 4)

_ROD = (
    '<link name="{0}"><inertial><origin xyz="0 0 {1}"/><mass value="1"/><inertia ixx="{2}" '
    'iyy="{2}" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
_FOOT = (
    '<link name="{0}_foot"/><joint name="{0}_ankle" type="fixed"><origin xyz="0 0 -1"/>'
    '<parent link="{0}"/><child link="{0}_foot"/></joint>'
)
A_FRAME = (
    '<robot name="a_frame">'
    + "".join(_ROD.format(name, -0.5, 1 / 12) + _FOOT.format(name) for name in ("left", "right"))
    + '<joint name="hinge" type="continuous"><parent link="left"/><child link="right"/>'
    '<axis xyz="0 1 0"/></joint></robot>'
)
"""Two rods of 1 m and 1 kg that lean against each other."""
FOOT = 0.02
"""Radius of the A-frame's feet, in m."""


def build(engine: str, solver: str | None, *robots: Robot, **options: object) -> Simulation:
    """Return a simulation on the ground."""
    world = World(robots, solver=solver, **{"ground": Ground(), **options})
    return plugins.resolve("backend", engine).build(world)


def slide(engine: str, solver: str | None, degrees: float) -> float:
    """Return the relative error of the distance that a cube slides from a speed of 2 m/s."""
    friction, speed = 0.5, 2.0
    cube = Box(name="cube", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1), friction=friction)
    with build(engine, solver, objects=[cube]) as simulation:
        simulation.step(20)
        q, v, angle = simulation.positions(), simulation.velocities(), math.radians(degrees)
        v[:2] = speed * math.cos(angle), speed * math.sin(angle)
        simulation.set_state(q, v)
        simulation.step(600)
        slid = math.hypot(*(simulation.positions() - q)[:2])
    return slid / (speed**2 / (2 * friction * GRAVITY)) - 1


def a_frame_stands(engine: str, solver: str | None, friction: float, degrees: float = 50) -> bool:
    """Return whether an A-frame stands, each rod at an angle to the vertical."""
    angle = math.radians(degrees)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a_frame.urdf"
        path.write_text(A_FRAME, encoding="utf-8")
        robot = Robot(
            path,
            fixed_base=False,
            position=(0, 0, math.cos(angle) + FOOT),
            orientation=(0, math.sin(angle / 2), 0, math.cos(angle / 2)),
            feet={"left_foot": FOOT, "right_foot": FOOT},
            friction=friction,
        )
        simulation = build(engine, solver, robot)
    with simulation:
        q = simulation.positions()
        q[7] = -2 * angle
        simulation.set_state(q, np.zeros(7))
        simulation.step(1000)
        return bool(q[2] - simulation.positions()[2] < 2e-3)


def a_frame_theory(degrees: float = 50) -> float:
    """Return the friction that an A-frame needs, from the moments about the hinge."""
    angle = math.radians(degrees)
    return 0.5 * math.sin(angle) / (math.cos(angle) + FOOT)


def a1_holds(engine: str, solver: str | None, ratio: float) -> bool:
    """Return whether a standing A1 withstands a diagonal push of `ratio` times its weight.

    The push grows for two seconds; then the robot has time to come to rest.
    """
    robot = Robot("a1/a1", "a1", fixed_base=False, position=(0, 0, 0.29), friction=FRICTION)
    with build(engine, solver, robot) as simulation:
        q = simulation.positions()
        q[7:] = STAND
        simulation.set_state(q, np.zeros(18))
        simulation.add_hook(_stand)
        simulation.step(800)
        force = ratio * GRAVITY * simulation.mass_matrix(q)[0, 0] / math.sqrt(2)
        profile = np.array([[0, 0, 0], [force, force, 0], [force, force, 0]])
        simulation.apply_wrench(Wrench("trunk", profile, times=(0.0, 2.0, 9.0)))
        simulation.step(4500)
        feet = [f"{leg}_foot" for leg in ("FL", "FR", "RL", "RR")]
        begin = simulation.body_poses(feet)
        simulation.step(500)
        moved = simulation.body_poses(feet) - begin
    return bool(np.hypot(moved[:, 0], moved[:, 1]).min() < 2e-4)


def _stand(simulation: Simulation) -> None:
    """Hold the legs of an A1 where they are."""
    q, v = simulation.positions(), simulation.velocities()
    simulation.set_torques(100 * (STAND - q[7:]) - 5 * v[6:])


def tumbling(engine: str, integrator: str) -> float:
    """Return the relative error of the energy of a free box after 10 s, at 8 rad/s."""
    box = Box(name="box", size=(0.4, 0.2, 0.1))
    world = World(objects=[box], gravity=(0, 0, 0), integrator=integrator)
    with plugins.resolve("backend", engine).build(world) as simulation:
        mass = simulation.mass_matrix(simulation.positions())
        v = np.array([0.1, 0.2, 0.3, 0.08, 8.0, 0.05])  # about the middle axis, so it turns over
        simulation.set_state(simulation.positions(), v)
        simulation.step(10_000)
        w = simulation.velocities()
        return float(abs(w[3:] @ mass[3:, 3:] @ w[3:] / (v[3:] @ mass[3:, 3:] @ v[3:]) - 1))


# Time -------------------------------------------------------------------------------------------


def ant(
    engine: str, solver: str | None, driven: bool, iterations: int | None = None
) -> tuple[Simulation, Callable[[], int]]:
    """Return an ant, at rest or driven by random torques, and a function that steps it."""
    options = {"period": 6.25e-3, "iterations": iterations}
    simulation = build(engine, solver, Robot("ant", fixed_base=False), **options)
    q = simulation.positions()
    q[2], q[8::2] = 0.377, 1.0
    simulation.set_state(q, np.zeros(14))
    random = np.random.default_rng(0)

    def work() -> int:
        for _ in range(10):
            simulation.set_torques(random.uniform(-15, 15, 8) if driven else np.zeros(8))
            simulation.step(8)
        return 80

    return simulation, work


def standing(engine: str, solver: str | None) -> tuple[Simulation, Callable[[], int]]:
    """Return a standing A1, and a function that steps it."""
    robot = Robot("a1/a1", "a1", fixed_base=False, position=(0, 0, 0.29))
    simulation = build(engine, solver, robot)
    q = simulation.positions()
    q[7:] = STAND
    simulation.set_state(q, np.zeros(18))
    simulation.add_hook(_stand)

    def work() -> int:
        simulation.step(100)
        return 100

    return simulation, work


def stack(engine: str, solver: str | None) -> tuple[Simulation, Callable[[], int]]:
    """Return a stack of five boxes, and a function that steps it."""
    boxes = [
        Box(name=f"box{i}", size=(0.2, 0.2, 0.2), position=(0, 0, 0.1 + 0.2 * i)) for i in range(5)
    ]
    simulation = build(engine, solver, objects=boxes)

    def work() -> int:
        simulation.step(30)
        return 30

    return simulation, work


SCENES: dict[str, Callable[[str, str | None], tuple[Simulation, Callable[[], int]]]] = {
    "ant at rest": lambda engine, solver: ant(engine, solver, False),
    "ant, random torques": lambda engine, solver: ant(engine, solver, True),
    "the same, iterations=5": lambda engine, solver: ant(engine, solver, True, 5),
    "A1 standing": standing,
    "stack of 5 boxes": stack,
}


def times() -> None:
    """Print the CPU time of a step with each solver in each scene, in µs."""
    print(f"{'µs a step':22}" + "".join(f"{engine[:4] + ' ' + s:>16}" for engine, s in PAIRS))
    for name, scene in SCENES.items():
        made = {f"{engine} {solver}": scene(engine, solver) for engine, solver in PAIRS}
        measured = rates({key: work for key, (_, work) in made.items()}, 5, time.process_time)
        print(
            f"{name:22}" + "".join(f"{1e6 / statistics.median(v):16.0f}" for v in measured.values())
        )
        for simulation, _ in made.values():
            simulation.close()


def rays(engine: str) -> float:
    """Return the CPU time of 64 rays among 20 shapes, in ms."""
    random = np.random.default_rng(0)
    boxes = [
        Box(name=f"box{i}", size=tuple(random.uniform(0.1, 0.4, 3)), position=place)
        for i, place in enumerate(random.uniform((-5, -5, 0.5), (5, 5, 2), (20, 3)).tolist())
    ]
    around = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    begins = np.tile([0.0, 0.0, 1.0], (64, 1))
    ends = begins + 10 * np.column_stack([np.cos(around), np.sin(around), 0 * around])
    with build(engine, None, objects=boxes) as simulation:

        def work() -> int:
            for _ in range(20):
                simulation.raycast(begins, ends)
            return 20

        [measured] = rates({engine: work}, 5, time.process_time).values()
    return 1e3 / statistics.median(measured)


def environments() -> float:
    """Print the steps per second of Ant-v0 on each engine; return Pinocchio's over DART's."""
    candidates = {engine: _episodes(engine) for engine in SOLVERS}
    measured = rates(candidates, 5, time.process_time)
    report("physx/Ant-v0, random actions", "steps", measured, "dart", 0.0)
    pairs = zip(measured["pinocchio"], measured["dart"], strict=True)
    return statistics.median(mine / base for mine, base in pairs)


def _episodes(engine: str) -> Callable[[], int]:
    """Return a function that makes some steps of an ant."""
    env = gymnasium.make("physx/Ant-v0", backend=engine, disable_env_checker=True).unwrapped
    random = np.random.default_rng(0)

    def work() -> int:
        env.reset(seed=0)
        for _ in range(40):
            if any(env.step(random.uniform(-1, 1, 8).astype(np.float32))[2:4]):
                env.reset()
        return 40

    return work


def accuracy(engine: str, solver: str) -> dict[str, float]:
    """Return the relative errors of a solver."""
    found = {f"slide at {degrees}°": abs(slide(engine, solver, degrees)) for degrees in ANGLES}
    needed = a_frame_theory()
    found["A-frame"] = threshold(lambda mu: a_frame_stands(engine, solver, mu), needed)
    found["A1 pushed"] = threshold(lambda ratio: a1_holds(engine, solver, ratio), FRICTION)
    return found


def main() -> None:
    """Print everything; with ``--check``, the defaults must meet their targets."""
    met = []
    errors = {pair: accuracy(*pair) for pair in PAIRS}
    print(f"{'relative error':22}" + "".join(f"{e[:4] + ' ' + s:>16}" for e, s in PAIRS))
    for name in errors[PAIRS[0]]:
        print(f"{name:22}" + "".join(f"{errors[pair][name]:16.1e}" for pair in PAIRS))
    print()
    for engine, solvers in SOLVERS.items():
        worst = max(errors[engine, solvers[0]].values())
        met.append(claim(f"{engine}: largest error of friction", worst, at_most=WORST[engine]))
        met.append(
            claim(
                f"{engine}: A-frame at 50°, µ = 0.62 stands",
                float(a_frame_stands(engine, None, 0.62)),
                at_least=1,
            )
        )
        for integrator in ("euler", "rk4"):
            error = tumbling(engine, integrator)
            print(f"{engine}, {integrator}: energy of a tumbling box after 10 s: {error:.1e}")
        met.append(claim(f"{engine}: the same, rk4", error, at_most=1e-3))
    print()
    for engine, share in table(tuple(SOLVERS)).items():
        met.append(claim(f"{engine}: worst case, of its limit", share, at_most=1.0))
    times()
    print()
    met += [
        claim(f"{each}: ms for 64 rays, 20 shapes", rays(each), at_most=0.5) for each in SOLVERS
    ]
    met.append(claim("Ant-v0, pinocchio / dart", environments(), at_least=0.4))
    finish(met)


if __name__ == "__main__":
    main()
