"""Write the table docs/robots.md: every named robot, loaded, stepped and compared on both engines.

Each robot has a process of its own, so that a crash or an endless loop would be seen.

    python benchmarks/robots.py
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from physx_core import PhysxError, Robot, Simulation, World, plugins
from physx_core.simulation import RobotInfo
from physx_dart.shared.robot_files import find_robot
from physx_dart.shared.urdf import read_robot

ENGINES = ("dart", "pinocchio")
STATES, STEPS, LOADS, TIMEOUT, NEGLIGIBLE = 20, 200, 5, 300, 1e-6
PAGE = Path(__file__).parents[1] / "docs" / "robots.md"
INTRODUCTION = """# Robots

`Robot("cartpole")` and `Robot("a1/a1")` name a robot instead of a file: an own one, or one of the
package `example-robot-data` (`pip install "physx-dart[robots]"`). `physx robots` lists them.

The table is made by `benchmarks/robots.py`, with {versions}.
Each robot floats freely (one whose root link has no mass is fixed), is loaded without collision
shapes, then makes {steps} steps
of 1 ms without torques from its neutral configuration. *Agreement* is the largest difference of the
engines' accelerations in {states} random states, relative to the largest acceleration of the state.
Columns *dof* (of the joints) and *mass* in kg; *load* in ms of a processor, the least of {loads}
loads. Where *collisions* says meshes,
`Robot(collisions="boxes")` or `"capsules"` is many times faster.

| robot | dof | mass | collisions | load dart, pinocchio | steps dart, pinocchio | agreement |
|---|---|---|---|---|---|---|
"""


def measure(name: str) -> dict[str, object]:
    """Return what the two engines do with a robot; it floats if its root link has a mass."""
    model = read_robot(Robot(name))
    mass = ElementTree.fromstring(model.text).find("link/inertial/mass")
    floats = mass is not None and float(mass.get("value", "0")) > NEGLIGIBLE
    robot = Robot(name, fixed_base=not floats, collisions="none")
    found: dict[str, object] = {"load": [], "steps": []}
    world, accelerations = World([robot]), []
    for engine in ENGINES:
        backend, loads = plugins.resolve("backend", engine), []
        for _ in range(LOADS):
            begin = time.process_time()
            backend.build(world).close()
            loads.append(1e3 * (time.process_time() - begin))
        found["load"] += [min(loads)]
        with backend.build(world) as simulation:
            rng, layout = np.random.default_rng(0), simulation.layout
            rows = []
            for _ in range(STATES):
                q = simulation.positions()
                q[len(q) - len(layout.joints) :] = rng.uniform(-1, 1, len(layout.joints))
                v, tau = rng.uniform(-1, 1, (2, layout.nv))
                rows.append(simulation.forward_dynamics(q, v, tau))
            accelerations.append(np.array(rows))
            found["steps"] += [_steps(simulation)]
    one, other = accelerations
    found["agreement"] = float(
        (np.abs(one - other).max(axis=1) / np.abs(other).max(axis=1)).max() if one.size else 0.0
    )
    return found


def _steps(simulation: Simulation) -> str:
    try:
        simulation.step(STEPS)
    except PhysxError as error:
        return str(error).split(",")[0]
    return "yes" if np.isfinite(simulation.positions()).all() else "not finite"


def row(info: RobotInfo) -> str:
    """Return a robot's line of the table, measured in a process of its own."""
    command = [sys.executable, __file__, info.name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return f"| `{info.name}` | | | | no answer within {TIMEOUT} s | | |"
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [""])[-1]
        return f"| `{info.name}` | | | | exit status {done.returncode}: {last} | | |"
    found = json.loads(done.stdout.splitlines()[-1])
    if "error" in found:
        return f"| `{info.name}` | | | | {found['error']} | | |"
    load = ", ".join(f"{ms:.3g}" for ms in found["load"])
    return (
        f"| `{info.name}` | {info.joints} | {info.mass:.4g} | {info.collisions} | {load} | "
        f"{', '.join(found['steps'])} | {found['agreement']:.0e} |"
    )


def main() -> None:
    """Measure one robot and print it as JSON, or all of them and write the page."""
    if len(sys.argv) > 1:
        try:
            found = measure(sys.argv[1])
        except PhysxError as error:
            folder = find_robot(sys.argv[1]).parent
            text = str(error).splitlines()[0].rstrip(":").replace(f"{folder}/", "")
            found = {"error": f"{type(error).__name__}: {text}"}
        print(json.dumps(found))
        return
    rows = []
    with ThreadPoolExecutor(2) as pool:
        for line in pool.map(row, plugins.resolve("backend", "pinocchio").robots()):
            rows.append(line)
            print(line, flush=True)
    versions = ", ".join(
        f"{name} {version(name)}" for name in ("dartpy", "pin", "example-robot-data")
    )
    text = INTRODUCTION.format(versions=versions, steps=STEPS, states=STATES, loads=LOADS)
    PAGE.write_text(text + "\n".join(rows) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
