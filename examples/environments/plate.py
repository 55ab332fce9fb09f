"""A triangulated plate with a hole: heat spreads in it, faster where it conducts well."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from physx_core import Environment, Field

SIDE, RADIUS, SPACE = 1.0, 0.2, 0.1  # side, radius of the hole, space between nodes, in m


def mesh() -> tuple[np.ndarray, np.ndarray]:
    """Return the irregular mesh of the plate: nodes (n, 2) in m, and triangles (m, 3)."""
    axis = np.linspace(0, SIDE, round(SIDE / SPACE) + 1)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1)
    inner = nodes[1:-1, 1:-1]
    inner += np.random.default_rng(0).uniform(-0.3 * SPACE, 0.3 * SPACE, inner.shape)
    far = np.linalg.norm(nodes - SIDE / 2, axis=-1) > RADIUS + SPACE / 2
    turns = np.linspace(0, 2 * np.pi, round(2 * np.pi * RADIUS / SPACE), endpoint=False)
    rim = SIDE / 2 + RADIUS * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    nodes = np.concatenate([nodes[far], rim])
    triangles = Delaunay(nodes).simplices
    outside = np.linalg.norm(nodes[triangles].mean(axis=1) - SIDE / 2, axis=-1) > RADIUS
    return nodes, triangles[outside]


class Plate(Environment):
    """Temperature and conductivity at the nodes of a mesh -> temperature a little later.

    The heat equation, with linear finite elements, lumped masses and implicit Euler steps. No heat
    leaves the plate.
    """

    independent_episodes, episode_steps = True, 1
    STEPS, PERIOD = 10, 1e-3  # implicit steps, and the length of each in s
    LENGTH = 0.15  # over which temperature and conductivity vary, in m

    def create(self) -> None:
        nodes, self.triangles = mesh()
        corners = nodes[self.triangles]
        sides = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
        areas = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / 2
        self.stiffness = sides @ sides.transpose(0, 2, 1) / (4 * areas[:, None, None])
        self.masses = np.zeros(len(nodes))
        np.add.at(self.masses, self.triangles, areas[:, None] / 3)
        distances = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
        alike = np.exp(-((distances / self.LENGTH) ** 2) / 2) + 1e-6 * np.eye(len(nodes))
        self.smooth = np.linalg.cholesky(alike)

    def init_database(self) -> None:
        count = len(self.masses)
        self.define_training_fields(
            [Field("before", (count, 2), unit="K, m2/s"), Field("after", (count, 1), unit="K")]
        )

    def step(self) -> None:
        temperature, patches = (self.smooth @ self.rng.standard_normal((len(self.masses), 2))).T
        conductivity = np.exp(patches)
        parts = self.stiffness * conductivity[self.triangles].mean(axis=1)[:, None, None]
        places = np.broadcast_to(self.triangles[:, :, None], parts.shape)
        ends = places.ravel(), places.swapaxes(1, 2).ravel()
        stiffness = coo_array((parts.ravel(), ends), shape=(len(self.masses),) * 2)
        matrix = splu((diags_array(self.masses) + self.PERIOD * stiffness).tocsc())
        after = temperature
        for _ in range(self.STEPS):
            after = matrix.solve(self.masses * after)
        before = np.stack([temperature, conductivity], axis=-1)
        self.set_training_data(before=before, after=after[:, None])
