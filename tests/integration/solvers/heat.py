"""Nonlinear heat conduction with scikit-fem, in this process: one simulation is one row.

The conductivity k = 1 + beta u^2 may become negative; Newton's method diverges then.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import skfem as fem
from skfem.helpers import dot, grad

from physx_core import Environment, Field, Parameter

WIDTH = 0.15  # of the heated spot, in m


@fem.BilinearForm
def tangent(u, v, w):
    """Derivative of the residual."""
    k, slope = 1 + w.beta * w.now**2, 2 * w.beta * w.now
    return k * dot(grad(u), grad(v)) + slope * u * dot(grad(w.now), grad(v))


@fem.LinearForm
def residual(v, w):
    """Heat that flows out minus the heat of a laser spot."""
    distance = (w.x[0] - w.x0) ** 2 + (w.x[1] - w.y0) ** 2
    source = w.power * np.exp(-distance / (2 * WIDTH**2))
    return (1 + w.beta * w.now**2) * dot(grad(w.now), grad(v)) - source * v


class Heat(Environment):
    """An L-shaped plate with cold edges, heated in a spot."""

    episode_steps = 1

    def __init__(self, *, refinements=4, **kwargs):
        """Store how often the mesh is refined."""
        super().__init__(**kwargs)
        self.refinements = refinements

    def create(self):
        """Make the mesh, and define what differs between simulations."""
        mesh = fem.MeshTri.init_lshaped().refined(self.refinements)
        self.basis = fem.Basis(mesh, fem.ElementTriP1())
        self.edge = mesh.boundary_nodes()
        spot = Parameter("spot", [-0.9, -0.9], [0.9, 0.9], shape=(2,), unit="m")
        power = Parameter("power", 20.0, 2000.0, distribution="log_uniform", unit="W/m^3")
        self.define_parameters([spot, power, Parameter("beta", -0.15, 0.3, unit="1/K^2")])

    def init_database(self):
        """Define a row."""
        temperature = Field("temperature", (self.basis.N,), unit="K")
        self.define_training_fields([Field("given", (4,)), temperature])
        self.define_additional_fields([Field("iterations", (), "int32")])

    def reset_parameters(self, spot, power, beta):
        """Prepare a simulation."""
        self.spot, self.power, self.beta = spot, power, beta

    def step(self):
        """Solve."""
        note(self, "begins")
        temperature, iterations = self.solve()
        given = [*self.spot, np.log(self.power), self.beta]
        self.set_training_data(given=given, temperature=temperature)
        self.set_additional_data(iterations=iterations)
        note(self, "ends")

    def solve(self):
        """Return the temperature of each node, shape (n,), in K, and the number of iterations."""
        x0, y0 = self.spot
        given = {"beta": self.beta, "power": self.power, "x0": x0, "y0": y0}
        u = np.zeros(self.basis.N)
        for iteration in range(20):
            now = self.basis.interpolate(u)
            r = residual.assemble(self.basis, now=now, **given)
            r[self.edge] = 0
            if np.linalg.norm(r) < 1e-10 * self.power:
                return u, iteration
            k = tangent.assemble(self.basis, now=now, **given)
            u = u - fem.solve(*fem.condense(k, r, D=self.edge))
        note(self, "ends")
        raise ArithmeticError(f"Newton diverged with beta = {self.beta:.3f}")


def note(environment, what):
    """Log what a simulation does."""
    with Path("solver.log").open("a") as file:
        file.write(f"{environment.episode_index} {what}\n")
