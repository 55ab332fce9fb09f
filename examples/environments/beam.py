"""A beam that is pushed: it generates samples, and shows a network's predictions."""

import time

import numpy as np
from environments.beam_solver import GRID, ElasticBeam, NoEquilibriumError

from physx_core import Environment, Field, Prediction

GREATEST_FORCE = 100.0  # N; some pushes this strong move its end by most of its length
COLORS = {"linear elasticity": "dodgerblue", "network": "orange"}
PATCH = 0.12  # m, the standard deviation of the forces around the center of a push


class Beam(Environment):
    """In each step, a random push on the surface bends the beam, and the solver computes how far.

    The displacement is that of linear elasticity plus a correction. The beam with the network's
    prediction of the correction is drawn over the solver's, along with that of linear elasticity.
    """

    constants = ("solver",)

    def create(self) -> None:
        self.solver = ElasticBeam()
        self.rest = self.solver.rest.reshape(-1, 3)
        self.outside = np.zeros(len(self.rest), bool)
        self.outside[self.solver.skin] = True
        self.outside &= self.rest[:, 0] > 0  # clamped nodes need no force
        self.centers = self.rest[self.outside & (self.rest[:, 0] > 0.3)]
        self.exact = np.zeros(GRID)

    def push(self) -> np.ndarray:
        """Return forces around a random place on the surface, shape GRID, in N."""
        squares = ((self.rest - self.rng.choice(self.centers)) ** 2).sum(axis=1)
        weights = np.exp(-squares / (2 * PATCH**2)) * self.outside
        direction = self.rng.standard_normal(3)
        force = GREATEST_FORCE * self.rng.uniform(0.2, 1) * direction / np.linalg.norm(direction)
        return (weights[:, None] / weights.sum() * force).reshape(GRID)

    def init_database(self) -> None:
        results = [Field(name, GRID, unit="mm") for name in ("displacement", "correction")]
        self.define_training_fields([Field("forces", GRID, unit="N"), *results])
        self.define_additional_fields([Field("seconds", (2,), unit="s")])

    def step(self) -> None:
        self.forces, begin = self.push(), time.thread_time()
        self.linear, between = 1e3 * self.solver.linear(self.forces), time.thread_time()
        try:
            self.exact, self.solved = 1e3 * self.solver.solve(self.forces), True
        except NoEquilibriumError:
            self.solved = False
        seconds = np.array([time.thread_time() - between, between - begin])
        correction = self.exact - self.linear
        self.set_training_data(forces=self.forces, displacement=self.exact, correction=correction)
        self.set_additional_data(seconds=seconds)

    def check_sample(self) -> bool:
        return self.solved

    def init_visualization(self) -> None:
        self.factory.set_view("beam", eye=[0.6, -1.6, 0.6], target=[0.5, 0.12, 0.08])
        self.factory.add_mesh("solver", self.rest, self.solver.skin, color="lightgray")
        for name, color in COLORS.items():
            self.factory.add_mesh(name, self.rest, self.solver.skin, color=color, wireframe=True)
        self.factory.add_arrows("forces", self.rest, 0 * self.rest, color="red")
        self.factory.add_scalars("error", list(COLORS))

    def apply_prediction(self, prediction) -> None:
        corrected = self.linear + prediction["correction"]
        found = {"linear elasticity": self.linear, "network": corrected}
        errors = [np.linalg.norm(each - self.exact) for each in found.values()]
        for name, each in {**found, "solver": self.exact}.items():
            self.factory.update_mesh(name, positions=self.rest + each.reshape(-1, 3) / 1e3)
        places, vectors = self.rest + self.exact.reshape(-1, 3) / 1e3, self.forces.reshape(-1, 3)
        self.factory.update_arrows("forces", positions=places, vectors=0.1 * vectors)
        self.factory.update_scalars("error", errors / np.linalg.norm(self.exact))


class Timed(Prediction):
    """Records each push's deflection and the CPU s of solver, linear elasticity and network."""

    found = ()

    def sample_end(self):
        begin = time.thread_time()
        self.learner.predict(self.batch)
        seconds = *self.batch["seconds"][0], time.thread_time() - begin
        self.found += ((np.linalg.norm(self.batch["displacement"]), *seconds),)
