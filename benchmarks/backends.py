"""The simulations against hand-written loops of the same dartpy and pinocchio calls.

One unit of work is a control period: torques set once, ten physics steps, positions and velocities
read once. The raw loops simulate the same world, taken from a simulation of physx. Times are
processor times: nothing here waits.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dartpy
import numpy as np
import pinocchio
from measure import claim, finish, rates, report

from physx_core import plugins
from physx_sim import Ground, Robot, World
from physx_sim.engines import EXAMPLE_DATA, example_data_dir, example_robot

ROUNDS, STEPS, PERIODS = 15, 10, 100
STAND = np.tile([0.0, 0.8, -1.6], 4)
CARTPOLE = """
<robot name="cartpole">
  <link name="rail"/>
  <joint name="slider" type="prismatic">
    <parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-100" upper="100" velocity="1000" effort="100"/>
  </joint>
  <link name="cart"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous">
    <parent link="cart"/><child link="pole"/><axis xyz="0 1 0"/>
  </joint>
  <link name="pole"><inertial><origin xyz="0 0 0.5"/><mass value="0.1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>
"""

Work = Callable[[], Iterator[int]]


def worlds(folder: Path) -> dict[str, tuple[World, np.ndarray]]:
    """Return the simulated worlds, and the torques that are held in each."""
    path = folder / "cartpole.urdf"
    path.write_text(CARTPOLE, encoding="utf-8")
    a1 = Robot(example_robot("a1_description/urdf/a1.urdf"), "a1", fixed_base=False)
    standing = Robot(a1.urdf, "a1", fixed_base=False, position=(0.0, 0.0, 0.29))
    return {
        "cartpole": (World([Robot(path)]), np.array([0.1, 0.0])),
        "quadruped in the air": (World([a1]), np.zeros(12)),
        "quadruped standing": (World([standing], ground=Ground()), np.zeros(12)),
    }


def begin(simulation: Any, title: str) -> None:
    """Set a world to the state in which each round starts."""
    q, v = simulation.positions(), simulation.velocities()
    if title == "cartpole":
        q[:] = 0.0, 0.3
    else:
        q[7:] = STAND
        q[2] = 0.29 if title == "quadruped standing" else 50.0
    simulation.set_state(q, 0 * v)


def torques_of(title: str, held: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the torques of one control period; the standing quadruped has a controller."""
    if title != "quadruped standing":
        return held
    return 60.0 * (STAND - q[-12:]) - 2.0 * v[-12:]


def through_physx(engine: str, title: str, world: World, held: np.ndarray) -> Work:
    """Return work that makes control periods through the interface of physx."""

    def physx() -> Iterator[int]:
        with plugins.resolve("backend", engine).build(world) as simulation:
            begin(simulation, title)
            q, v = simulation.positions(), simulation.velocities()
            yield 0
            for _ in range(PERIODS):
                simulation.set_torques(torques_of(title, held, q, v))
                simulation.step(STEPS)
                q, v = simulation.positions(), simulation.velocities()
            yield PERIODS

    return physx


def raw_dart(title: str, world: World, held: np.ndarray) -> Work:
    """Return work that makes control periods with dartpy's own calls."""

    def dartpy_calls() -> Iterator[int]:
        with plugins.resolve("backend", "dart").build(world) as simulation:
            begin(simulation, title)
            skeleton = simulation._robots[0].skeleton
            engine, free = simulation._world, skeleton.getNumDofs() - len(held)
            q, v = skeleton.getPositions(), skeleton.getVelocities()
            forces = np.zeros(skeleton.getNumDofs())
            yield 0
            for _ in range(PERIODS):
                forces[free:] = torques_of(title, held, q, v)
                skeleton.setForces(forces)
                for _ in range(STEPS):
                    engine.step(False)
                q, v = skeleton.getPositions(), skeleton.getVelocities()
            yield PERIODS

    return dartpy_calls


def raw_pinocchio(title: str, world: World, held: np.ndarray) -> Work:
    """Return work that makes control periods with pinocchio's own calls."""

    def pinocchio_calls() -> Iterator[int]:
        with plugins.resolve("backend", "pinocchio").build(world) as simulation:
            begin(simulation, title)
            robot = simulation._robots[0]
            model, (q, v) = robot._model, robot.native()
            data, dt = model.createData(), world.period
            tau, free = np.zeros(model.nv), model.nv - len(held)
            yield 0
            for _ in range(PERIODS):
                tau[free:] = torques_of(title, held, q, v)
                for _ in range(STEPS):
                    v = v + dt * pinocchio.aba(model, data, q, v, tau)
                    q = pinocchio.integrate(model, q, dt * v)
            yield PERIODS

    return pinocchio_calls


def stepping(folder: Path) -> list[bool]:
    """Compare control periods with the raw calls of both engines."""
    met = []
    for engine, raw, targets in (
        ("dart", raw_dart, (1.3, 1.1, 1.05)),
        ("pinocchio", raw_pinocchio, (1.3, 1.1, None)),
    ):
        for (title, (world, held)), target in zip(worlds(folder).items(), targets, strict=True):
            if target is None:
                continue
            candidates = {
                "raw calls": raw(title, world, held),
                "physx": through_physx(engine, title, world, held),
            }
            measured = rates(candidates, ROUNDS, time.process_time)
            heading = (
                f"{engine}, {title}: control periods of {STEPS} steps; "
                f"{target} times as long is a ratio of {1 / target:.2f}"
            )
            met.append(report(heading, "periods", measured, "raw calls", 1 / target, "physx"))
    return met


def loading() -> bool:
    """Compare loading A1 with dartpy's own loader, which also loads visual shapes."""
    path = example_robot("a1_description/urdf/a1.urdf")
    world = World([Robot(path, "a1", fixed_base=False)], ground=Ground())
    backend = plugins.resolve("backend", "dart")

    def own() -> int:
        loader = dartpy.utils.DartLoader()
        loader.addPackageDirectory(EXAMPLE_DATA, str(example_data_dir()))
        if loader.parseSkeleton(str(path)) is None:
            raise RuntimeError("dartpy cannot load A1")
        return 1

    def physx() -> int:
        for _ in range(10):
            backend.build(world).close()
        return 10

    measured = rates({"dartpy's loader": own, "physx": physx}, 3, time.process_time)
    heading = "Loading A1 with its collision shapes and the ground"
    return report(heading, "loads", measured, "dartpy's loader", 50, "physx")


_MEMORY = """
import os, sys, dartpy
from physx_core import plugins
from physx_sim import Ground, Robot, World

def bare():
    world = dartpy.simulation.World()
    world.getConstraintSolver().setCollisionDetector(dartpy.collision.BulletCollisionDetector())
    box = dartpy.dynamics.Skeleton("box")
    _, body = box.createFreeJointAndBodyNodePair()
    body.createShapeNode(dartpy.dynamics.BoxShape([1, 1, 1])).createCollisionAspect()
    world.addSkeleton(box)
    world.step()
    return world

def a1():
    robot = Robot(sys.argv[2], "a1", fixed_base=False)
    simulation = plugins.resolve("backend", "dart").build(World([robot], ground=Ground()))
    simulation.step(5)
    return simulation

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

kept = []
for number in range(60):
    kept.append({"bare": bare, "a1": a1}[sys.argv[1]]())
    if number == 9:
        before = resident()
print((resident() - before) / 50)
"""


def memory() -> bool:
    """Measure the memory of each additional world with A1, beside one of dartpy with a box.

    Bullet reserves several MB for each world, whatever is in it.
    """
    path = str(example_robot("a1_description/urdf/a1.urdf"))
    found = {}
    for kind in ("bare", "a1"):
        command = [sys.executable, "-W", "ignore", "-c", _MEMORY, kind, path]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        found[kind] = float(done.stdout.splitlines()[-1])
    print(f"Memory of each further world: a box in dartpy {found['bare']:.2f} MB")
    return claim("A1 in physx above it, MB", found["a1"] - found["bare"], at_most=1.0)


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as name:
        met = stepping(Path(name))
    met += [loading(), memory()]
    finish(met)


if __name__ == "__main__":
    main()
