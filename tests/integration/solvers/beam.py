"""Large deflection of a beam with CalculiX, an unmodified program that reads and writes files."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np

from physx_core import Environment, Field, Parameter

CELLS = (8, 2, 2)
CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))


def box(cells, size):
    """Return the nodes of a box, shape (n, 3), and the node numbers of its cells, shape (m, 8)."""
    axes = [np.linspace(0, length, count + 1) for length, count in zip(size, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape([count + 1 for count in cells])
    corner = [number[tuple(slice(c, n + c) for c, n in zip(at, cells, strict=True))]
              for at in CORNERS]  # fmt: skip
    return nodes, np.stack(corner, -1).reshape(-1, 8)


class Beam(Environment):
    """A clamped beam of a square section under a load at its end.

    ``faults`` has the number of an episode, as text, and what is in the solver's place: `hangs`
    and `crashes` end by themselves and by this environment; of `is silent`, only physx knows.
    """

    episode_steps = 1

    def __init__(self, *, faults=None, **kwargs):
        """Store what goes wrong when."""
        super().__init__(**kwargs)
        self.faults = faults or {}

    def create(self):
        """Make the mesh and a folder for the solver."""
        self.nodes, self.cells = box(CELLS, (1, 0.1, 0.1))
        self.folder = Path(f"solver_{self.instance_id}")
        self.folder.mkdir(exist_ok=True)
        young = Parameter("young", 1e6, 1e8, distribution="log_uniform", unit="Pa")
        load = Parameter("load", [-20.0, -20.0], [20.0, 20.0], shape=(2,), unit="N")
        self.define_parameters([young, load])

    def init_database(self):
        """Define a row."""
        displacement = Field("displacement", self.nodes.shape, unit="m")
        self.define_training_fields([Field("given", (3,)), displacement])

    def reset_parameters(self, young, load):
        """Prepare a simulation."""
        self.young, self.load = young, load

    def step(self):
        """Solve."""
        note(self, "begins")
        displacement = self.solve(self.faults.get(str(self.episode_index), ""))
        given = [np.log(self.young), *self.load]
        self.set_training_data(given=given, displacement=displacement)
        note(self, "ends")

    def solve(self, fault):
        """Return the displacement of each node, shape (n, 3), in m."""
        (self.folder / "job.inp").write_text(self.deck())
        command = {
            "hangs": ["sleep", "1000"],
            "is silent": ["sleep", "1000"],
            "crashes": ["sh", "-c", "kill -SEGV $$"],
        }.get(fault, ["ccx", "job"])
        done = subprocess.run(
            command,
            cwd=self.folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=1 if fault == "hangs" else None,
            check=False,
        )
        if done.returncode or "*ERROR" in done.stdout:
            raise RuntimeError(f"{command[0]} ended with {done.returncode}")
        return last_displacement(self.folder / "job.frd")

    def deck(self):
        """Return the solver's input."""
        end = np.flatnonzero(self.nodes[:, 0] == 1) + 1
        fixed = np.flatnonzero(self.nodes[:, 0] == 0) + 1
        return "\n".join([
            "*NODE,NSET=ALL",
            *(f"{i},{x:.9g},{y:.9g},{z:.9g}" for i, (x, y, z) in enumerate(self.nodes, 1)),
            "*ELEMENT,TYPE=C3D8I,ELSET=BEAM",
            *(f"{i},{','.join(map(str, cell + 1))}" for i, cell in enumerate(self.cells, 1)),
            "*NSET,NSET=FIXED",
            *(f"{i}," for i in fixed),
            "*MATERIAL,NAME=RUBBER",
            "*ELASTIC",
            f"{self.young:.9g},0.4",
            "*SOLID SECTION,ELSET=BEAM,MATERIAL=RUBBER",
            "*STEP,NLGEOM,INC=30",
            "*STATIC",
            "0.5,1.,0.1,1.",
            "*BOUNDARY",
            "FIXED,1,3",
            "*CLOAD",
            *(f"{i},{k},{f / len(end):.9g}" for i in end for k, f in zip((2, 3), self.load,
                                                                       strict=True)),
            "*NODE FILE",
            "U",
            "*END STEP",
            "",
        ])  # fmt: skip


def last_displacement(results):
    """Read the last block of displacements, shape (n, 3), from a solver's file of results."""
    block, reads = [], False
    for line in results.read_text().splitlines():
        if line.startswith(" -4"):
            block, reads = [], "DISP" in line
        elif reads and line.startswith(" -1"):
            block.append([float(line[begin : begin + 12]) for begin in (13, 25, 37)])
        elif line.startswith(" -3"):
            reads = False
    return np.array(block)


def note(environment, what):
    """Log what a simulation does."""
    with Path("solver.log").open("a") as file:
        file.write(f"{environment.episode_index} {what}\n")
