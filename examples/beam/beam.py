"""A hyperelastic beam, clamped at one end: its solver, and the environment that makes samples.

The mesh is a regular grid of 16 x 4 x 4 nodes with a hexahedron in each of its cells, so that a
field on the nodes of the mesh is an array of shape (16, 4, 4, components), and a picture of three
dimensions for convolutions as well.
"""

from __future__ import annotations

import time

import felupe
import numpy as np
from scipy.sparse.linalg import splu

from physx_core import Environment, Field

NODES = (16, 4, 4)
SIZE = (1.0, 0.25, 0.25)  # m
YOUNG, POISSON = 1e5, 0.3  # Pa, 1


class NoEquilibriumError(ArithmeticError):
    """Newton's method found no equilibrium."""


class ElasticBeam:
    """A Neo-Hookean solid on linear hexahedra, in static equilibrium with forces on its nodes.

    Attributes:
        rest: Positions of the nodes at rest, shape (*NODES, 3), in m.
        displacement: Displacements in equilibrium, shape (*NODES, 3), in m.
        forces: The forces that belong to them, shape (*NODES, 3), in N.
        iterations: Number of linear systems that were solved.
    """

    def __init__(self) -> None:
        mesh = felupe.Cube(b=SIZE, n=NODES)
        self._field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
        mu = YOUNG / (2 * (1 + POISSON))
        lame = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
        self._solid = felupe.SolidBody(felupe.NeoHookeCompressible(mu, lame), self._field)
        # felupe counts nodes along x first; in our arrays x is the first axis
        self._order = np.arange(mesh.npoints).reshape(NODES[::-1]).transpose().ravel()
        clamped = felupe.Boundary(self._field[0], fx=0.0)
        _, self._free = felupe.dof.partition(self._field, {"clamped": clamped})
        self.rest = mesh.points[self._order].reshape(*NODES, 3)
        self.iterations = 0
        self.relax()

    def relax(self) -> None:
        """Go back to the state at rest."""
        self.displacement = np.zeros((*NODES, 3))
        self.forces = np.zeros((*NODES, 3))

    def solve(self, forces: np.ndarray, halvings: int = 5) -> None:
        """Find the equilibrium with other forces, beginning at the present one.

        Where Newton's method fails, it goes there in two steps of half the size.

        Raises:
            NoEquilibriumError: It fails after as many halvings too; the state is as before.
        """
        before = self.displacement, self.forces
        try:
            self.displacement, self.forces = self._newton(forces), forces
        except NoEquilibriumError:
            if not halvings:
                raise
            try:
                self.solve((before[1] + forces) / 2, halvings - 1)
                self.solve(forces, halvings - 1)
            except NoEquilibriumError:
                self.displacement, self.forces = before
                raise

    def _newton(self, forces: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
        """Return the displacements that balance the forces, to a part `tolerance` of them."""
        external = self._to_mesh(forces)[self._free]
        values = self._to_mesh(self.displacement)
        limit = tolerance * max(np.linalg.norm(external), 1e-3)
        error = self._residual(values, external)
        for _ in range(20):
            if np.linalg.norm(error) <= limit:
                return self._to_grid(values)
            values, error = self._improve(values, error, external)
        raise NoEquilibriumError

    def _improve(
        self, values: np.ndarray, error: np.ndarray, external: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Do one step of Newton's method, shortened where it would leave the solution far behind.

        What is unbalanced may grow for a step, as bending with large rotations needs it to.
        """
        stiffness = self._solid.assemble.matrix(self._field)[self._free][:, self._free].tocsc()
        options = {"SymmetricMode": True}
        factors = splu(stiffness, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        direction = factors.solve(error)
        self.iterations += 1
        for length in (1.0, 0.5, 0.25, 0.125):
            tried = values.copy()
            tried[self._free] += length * direction
            left = self._residual(tried, external)
            if np.linalg.norm(left) < 100 * np.linalg.norm(error):
                break
        if not np.isfinite(left).all():
            raise NoEquilibriumError
        return tried, left

    def _residual(self, values: np.ndarray, external: np.ndarray) -> np.ndarray:
        """Return the forces on the free nodes that nothing balances, in N."""
        self._field[0].values[:] = values.reshape(-1, 3)
        with np.errstate(invalid="ignore", divide="ignore"):  # a cell turned inside out
            inner = self._solid.assemble.vector(self._field).toarray().ravel()
        return external - inner[self._free]

    def _to_mesh(self, grid: np.ndarray) -> np.ndarray:
        values = np.empty((grid.size // 3, 3))
        values[self._order] = grid.reshape(-1, 3)
        return values.ravel()

    def _to_grid(self, values: np.ndarray) -> np.ndarray:
        return values.reshape(-1, 3)[self._order].reshape(*NODES, 3)


class Beam(Environment):
    """Forces push patches of the surface of the beam, and the solver finds its displacements.

    The forces go from one random load case to the next in a few steps, so that each solution is a
    good place to begin at for the next one, and every other sample is a mixture of two load cases.

    The network's prediction for the same forces is compared with the solver's displacements, and
    drawn over them.
    """

    STEPS_PER_CASE = 2
    GREATEST_FORCE = 50.0  # N
    PATCH = 0.12  # m, the standard deviation of the forces around the center of a patch

    def create(self) -> None:
        self.solver = ElasticBeam()
        places = np.indices(NODES)
        outside = np.zeros(NODES, bool)
        for axis, last in ((0, NODES[0] - 1), (1, NODES[1] - 1), (2, NODES[2] - 1)):
            outside |= (places[axis] == 0) & (axis > 0)
            outside |= places[axis] == last
        self.outside = outside & (places[0] > 0)  # clamped nodes need no force
        self.centers = self.solver.rest[self.outside & (places[0] >= NODES[0] // 3)]
        self.begin = self.end = self.load_case()
        self.part = self.STEPS_PER_CASE
        self.converged = True

    def load_case(self) -> np.ndarray:
        """Return forces on a random patch of the surface, shape (*NODES, 3), in N."""
        center = self.rng.choice(self.centers)
        squares = ((self.solver.rest - center) ** 2).sum(axis=-1)
        weights = np.exp(-squares / (2 * self.PATCH**2)) * self.outside
        direction = self.rng.standard_normal(3)
        direction *= self.rng.uniform(0.4, 1) * self.GREATEST_FORCE / np.linalg.norm(direction)
        return weights[..., None] / weights.sum() * direction

    def init_database(self) -> None:
        self.define_training_fields(
            [Field("forces", (*NODES, 3), unit="N"), Field("displacement", (*NODES, 3), unit="mm")]
        )
        self.define_additional_fields([Field("solver_seconds", (), unit="s")])

    def step(self) -> None:
        if self.part == self.STEPS_PER_CASE:
            self.begin, self.end, self.part = self.end, self.load_case(), 0
        self.part += 1
        forces = self.begin + (self.end - self.begin) * (self.part / self.STEPS_PER_CASE)
        begin = time.perf_counter()
        try:
            self.solver.solve(forces)
            self.converged = True
        except NoEquilibriumError:
            self.solver.relax()
            self.converged = False
        self.set_additional_data(solver_seconds=time.perf_counter() - begin)
        self.set_training_data(forces=forces, displacement=1e3 * self.solver.displacement)

    def check_sample(self) -> bool:
        return self.converged

    def init_visualization(self) -> None:
        rest = self.solver.rest.reshape(-1, 3)
        self.factory.set_view("beam", eye=[0.6, -1.3, 0.6], target=[0.5, 0.12, 0.08])
        self.factory.add_mesh("rest", rest, skin(), color="gray", alpha=0.15)
        self.factory.add_mesh("solver", rest, skin(), color="skyblue")
        self.factory.add_mesh("network", rest, skin(), color="orange", wireframe=True)
        self.factory.add_arrows("forces", rest, 0 * rest, color="red")
        self.factory.add_scalars("error", ["relative error"])

    def apply_prediction(self, prediction) -> None:
        if not self.factory:  # the positions are for drawing only
            return
        rest, exact = self.solver.rest, self.solver.displacement
        guess = prediction["displacement"] / 1e3
        self.factory.update_mesh("solver", positions=(rest + exact).reshape(-1, 3))
        self.factory.update_mesh("network", positions=(rest + guess).reshape(-1, 3))
        forces = self.solver.forces.reshape(-1, 3)
        places = (rest + exact).reshape(-1, 3)
        self.factory.update_arrows("forces", positions=places, vectors=0.1 * forces)
        self.factory.update_scalars("error", [relative_error(guess, exact)])
        self.update_visualization()


def relative_error(guess: np.ndarray, exact: np.ndarray) -> float:
    """Return the mean error of the nodes' displacements over their mean length."""
    lengths = np.linalg.norm(exact, axis=-1)
    return float(np.linalg.norm(guess - exact, axis=-1).mean() / lengths.mean())


def skin() -> np.ndarray:
    """Return the triangles of the surface, shape (m, 3), seen from outside counterclockwise."""
    numbers = np.arange(np.prod(NODES)).reshape(NODES)
    triangles = []
    for axis in range(3):
        for side in (0, -1):
            face = numbers.take(side, axis=axis)
            corners = face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]
            a, b, c, d = (corner.ravel() for corner in corners)
            if (side == 0) != (axis == 1):  # these corners turn against the normal
                b, d = d, b
            triangles += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return np.concatenate(triangles)
