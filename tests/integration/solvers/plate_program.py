"""The plate as a program of external/program, in an interpreter without physx."""

import math
from pathlib import Path

import physx
from plate_solver import PlateSolver


def note(given, what):
    """Log what a simulation does."""
    with Path("solver.log").open("a") as file:
        file.write("{} {}\n".format(given["episode"], what))


solver = PlateSolver()
run = physx.Run({"given": [0.0] * 3, "temperature": physx.Array("float64", (solver.nodes,))})
while True:
    given = run.parameters(k=0.0, spot=[0.0, 0.0], episode=0)
    note(given, "begins")
    temperature = solver.solve(given["k"], given["spot"])
    note(given, "ends")
    run.send(given=[math.log(given["k"]), *given["spot"]], temperature=temperature)
