"""A hyperelastic beam, clamped at one end, in equilibrium with forces on its nodes."""

import felupe
import numpy as np
from scipy.sparse.linalg import SuperLU, splu

NODES = (16, 4, 4)
GRID = (4, 4, 16, 3)  # values at the nodes: along z, y, x in felupe's order, components
SIZE = (1.0, 0.25, 0.25)  # m
YOUNG, POISSON = 1e5, 0.3  # Pa, 1: soft rubber


class NoEquilibriumError(ArithmeticError):
    """Newton's method found no equilibrium."""


class ElasticBeam:
    """A compressible Neo-Hookean solid of linear hexahedra.

    Attributes:
        rest: Positions of the nodes at rest, shape GRID, in m.
        skin: Triangles of the surface as node numbers, shape (m, 3).
    """

    def __init__(self) -> None:
        mesh = felupe.Cube(b=SIZE, n=NODES)
        self.rest = mesh.points.reshape(GRID)
        self._field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
        mu = YOUNG / (2 * (1 + POISSON))
        lame = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
        self._solid = felupe.SolidBody(felupe.NeoHookeCompressible(mu, lame), self._field)
        clamped = felupe.Boundary(self._field[0], fx=0.0)
        self._free = felupe.dof.partition(self._field, {"clamped": clamped})[1]
        self._at_rest = self._factorized()
        quads = felupe.RegionHexahedronBoundary(mesh).mesh_faces().cells
        self.skin = np.vstack([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])

    def linear(self, forces: np.ndarray) -> np.ndarray:
        """Return the displacements of linear elasticity, whose stiffness is factorized once."""
        return self._on_grid(self._at_rest.solve(forces.ravel()[self._free]))

    def solve(self, forces: np.ndarray, tolerance: float = 1e-6, most: int = 30) -> np.ndarray:
        """Return the displacements in equilibrium with forces, both of shape GRID, in m and N.

        Newton's method starts at rest. Steps that would triple the residual are shortened.

        Raises:
            NoEquilibriumError: If more than `tolerance` of the forces is left after `most` steps.
        """
        error = wanted = forces.ravel()[self._free]
        values, factors = np.zeros(wanted.size), self._at_rest
        for _ in range(most):
            direction, last = factors.solve(error), np.linalg.norm(error)
            for length in (1.0, 0.5, 0.25, 0.125):
                error = wanted - self._inner_forces(values + length * direction)
                if np.linalg.norm(error) < 3 * last:
                    break
            values = values + length * direction
            if np.linalg.norm(error) <= tolerance * np.linalg.norm(wanted):
                return self._on_grid(values)
            if not np.isfinite(error).all():
                break
            factors = self._factorized()
        raise NoEquilibriumError

    def _inner_forces(self, values: np.ndarray) -> np.ndarray:
        self._field[0].values[:] = self._on_grid(values).reshape(-1, 3)
        with np.errstate(all="ignore"):  # a cell may be inverted
            return self._solid.assemble.vector(self._field).toarray()[self._free, 0]

    def _on_grid(self, values: np.ndarray) -> np.ndarray:
        displacement = np.zeros(self.rest.size)
        displacement[self._free] = values
        return displacement.reshape(GRID)

    def _factorized(self) -> SuperLU:
        stiffness = self._solid.assemble.matrix(self._field)[self._free][:, self._free].tocsc()
        symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
        return splu(stiffness, "MMD_AT_PLUS_A", **symmetric)
