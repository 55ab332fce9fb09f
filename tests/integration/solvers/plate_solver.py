"""Steady heat conduction in a plate with dolfinx 0.5, which only Debian's own Python has."""

import ufl
from dolfinx import fem, mesh
from dolfinx.fem.petsc import LinearProblem
from mpi4py import MPI
from petsc4py.PETSc import ScalarType


class PlateSolver:
    """A square plate with cold edges, heated in a spot.

    Attributes:
        nodes: Number of nodes.
    """

    def __init__(self, cells=24):
        """Prepare the equations on a mesh of `cells` x `cells` squares."""
        plate = mesh.create_unit_square(MPI.COMM_SELF, cells, cells)
        space = fem.FunctionSpace(plate, ("Lagrange", 1))
        plate.topology.create_connectivity(1, 2)
        edge = mesh.exterior_facet_indices(plate.topology)
        cold = fem.locate_dofs_topological(space, 1, edge)
        self._k = fem.Constant(plate, ScalarType(1))
        self._spot = fem.Constant(plate, (ScalarType(0.5), ScalarType(0.5)))
        u, v = ufl.TrialFunction(space), ufl.TestFunction(space)
        x = ufl.SpatialCoordinate(plate)
        distance = (x[0] - self._spot[0]) ** 2 + (x[1] - self._spot[1]) ** 2
        self._problem = LinearProblem(
            self._k * ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx,
            ufl.exp(-50 * distance) * v * ufl.dx,
            bcs=[fem.dirichletbc(ScalarType(0), cold, space)],
            petsc_options={"ksp_type": "preonly", "pc_type": "lu"},
        )
        self.nodes = space.dofmap.index_map.size_local

    def solve(self, k, spot):
        """Return the temperature of each node, shape (n,), in K, for a conductivity in W/(m K)."""
        self._k.value, self._spot.value[:] = k, spot
        return self._problem.solve().x.array.copy()
