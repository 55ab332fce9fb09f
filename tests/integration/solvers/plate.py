"""An environment with a solver that its run's own interpreter does not have."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from physx_core import Environment, Field, Parameter


class Plate(Environment):
    """A square plate with cold edges, heated in a spot."""

    episode_steps = 1

    def create(self):
        """Prepare the solver, and define what differs between simulations."""
        from plate_solver import PlateSolver  # only where it runs

        self.solver = PlateSolver()
        spot = Parameter("spot", [0.2, 0.2], [0.8, 0.8], shape=(2,), unit="m")
        k = Parameter("k", 0.1, 10.0, distribution="log_uniform", unit="W/m/K")
        self.define_parameters([k, spot])

    def init_database(self):
        """Define a row."""
        temperature = Field("temperature", (self.solver.nodes,), unit="K")
        self.define_training_fields([Field("given", (3,)), temperature])

    def reset_parameters(self, k, spot):
        """Prepare a simulation."""
        self.k, self.spot = k, spot

    def step(self):
        """Solve."""
        self.note("begins")
        temperature = self.solver.solve(self.k, self.spot)
        self.set_training_data(given=[np.log(self.k), *self.spot], temperature=temperature)
        self.note("ends")

    def note(self, what):
        """Log what a simulation does."""
        with Path("solver.log").open("a") as file:
            file.write(f"{self.episode_index} {what}\n")
