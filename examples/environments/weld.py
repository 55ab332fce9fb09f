"""A laser draws a line on a plate: scikit-fem refines the mesh in each step, where it is hot."""

from __future__ import annotations

import numpy as np
import skfem as fem
from skfem.helpers import dot, grad

from physx_core import Environment, Field, Parameter

SIDE, WIDTH = 1.0, 0.06  # of the plate and of the laser's spot, in m
CONDUCTIVITY, HEATING = 1e-2, 60.0  # m²/s, and K/s in the middle of the spot
PERIOD = 0.05  # s
LEVELS = 3  # how often a triangle is divided at most
RISE = 0.3  # K: a triangle with a larger difference between its corners is divided


@fem.BilinearForm
def implicit(u, v, _):
    return u * v + PERIOD * CONDUCTIVITY * dot(grad(u), grad(v))


@fem.LinearForm
def explicit(v, w):
    return (w.before + PERIOD * w.source) * v


class Weld(Environment):
    """Temperature and heating at the nodes of a mesh -> temperature 50 ms later.

    An episode is a line between two points. Heat stays in the plate.
    """

    independent_episodes, episode_steps = True, 8

    def create(self) -> None:
        ends = ([0.1, 0.1], [0.9, 0.9])
        self.define_parameters(
            [Parameter(n, *ends, shape=(2,), unit="m") for n in ("start", "end")]
        )

    def init_database(self) -> None:
        self.define_training_fields(
            [
                Field("place", ("node", 2), unit="m"),
                Field("triangle", ("triangle", 3), "int64", indexes="node"),
                Field("edge", ("edge", 2), "int64", indexes="node"),
                Field("heating", ("node",), unit="K/s"),
                Field("before", ("node",), unit="K"),
                Field("after", ("node",), unit="K", like="before"),
            ]
        )

    def reset_parameters(self, start: np.ndarray, end: np.ndarray) -> None:
        self.path = list(np.linspace(start, end, self.episode_steps))
        axis = np.linspace(0, SIDE, 7)
        self.basis = fem.Basis(fem.MeshTri.init_tensor(axis, axis), fem.ElementTriP1())
        self.plain, self.temperature = self.basis.mesh, np.zeros(self.basis.N)

    def step(self) -> None:
        spot = self.path.pop(0)
        basis, before = self.refined(spot)
        heating = heating_at(basis.mesh.p, spot)
        matrix = implicit.assemble(basis)
        vector = explicit.assemble(
            basis, before=basis.interpolate(before), source=basis.interpolate(heating)
        )
        after = fem.solve(matrix, vector)
        self.basis, self.temperature = basis, after
        self.set_training_data(
            place=basis.mesh.p.T,
            triangle=basis.mesh.t.T.astype(np.int64),
            edge=basis.mesh.facets.T.astype(np.int64),
            heating=heating,
            before=before,
            after=after,
        )

    def refined(self, spot: np.ndarray) -> tuple[fem.Basis, np.ndarray]:
        """Return a mesh that fits the laser and the temperature, and the temperature on it."""
        known, mesh = self.basis.interpolator(self.temperature), self.plain
        for _ in range(LEVELS):
            temperature, heating = known(mesh.p), heating_at(mesh.p, spot)
            rises = [np.ptp(each[mesh.t], axis=0) for each in (temperature, PERIOD * heating)]
            is_near = np.linalg.norm(mesh.p[:, mesh.t].mean(axis=1).T - spot, axis=1) < WIDTH
            mesh = mesh.refined(np.flatnonzero(is_near | (np.max(rises, axis=0) > RISE)))
        return fem.Basis(mesh, fem.ElementTriP1()), known(mesh.p)


def heating_at(points: np.ndarray, spot: np.ndarray) -> np.ndarray:
    """Return how fast the laser heats points, shape (2, n), in K/s."""
    squares = ((points.T - spot) ** 2).sum(axis=1)
    return HEATING * np.exp(-squares / (2 * WIDTH**2))
