"""Triangulated plates of any shape and fineness: heat spreads, faster where they conduct well."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from physx_core import Environment, Field

SIDE, RADIUS = 1.0, 0.2  # side of the plate and radius of its hole, in m
SHAPES = ("hole", "corner")


def mesh(shape: str, space: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return an irregular mesh: nodes (n, 2) in m, and triangles (m, 3).

    The plate has a round hole in its middle, or lacks a corner: a quarter of it. `space` is the
    distance between nodes, in m.
    """
    axis = np.linspace(0, SIDE, round(SIDE / space) + 1)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1)
    nodes[1:-1, 1:-1] += rng.uniform(-0.3 * space, 0.3 * space, nodes[1:-1, 1:-1].shape)
    nodes = nodes.reshape(-1, 2)
    if shape == "hole":
        turns = np.linspace(0, 2 * np.pi, round(2 * np.pi * RADIUS / space), endpoint=False)
        rim = SIDE / 2 + RADIUS * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        far = np.linalg.norm(nodes - SIDE / 2, axis=-1) > RADIUS + space / 2
    else:
        edge = np.arange(0, SIDE / 2, space)
        middle = np.full_like(edge, SIDE / 2)
        rim = np.concatenate(
            [np.stack([SIDE - edge, middle], 1), np.stack([middle, SIDE - edge], 1)]
        )
        rim = np.concatenate([rim, [[SIDE / 2, SIDE / 2]]])
        far = nodes.min(axis=1) < SIDE / 2 - space / 2
    nodes = np.concatenate([nodes[far], rim])
    triangles = Delaunay(nodes).simplices
    middles = nodes[triangles].mean(axis=1)
    if shape == "hole":
        is_plate = np.linalg.norm(middles - SIDE / 2, axis=-1) > RADIUS
    else:
        is_plate = middles.min(axis=1) < SIDE / 2
    return nodes, triangles[is_plate]


class Plate(Environment):
    """Temperature and conductivity at the nodes of a mesh -> temperature a little later.

    The heat equation, with linear finite elements, lumped masses and implicit Euler steps. No heat
    leaves the plate. Each episode has a mesh of its own, of 20 to 2 000 nodes.
    """

    independent_episodes, episode_steps = True, 1
    STEPS, PERIOD = 10, 1e-3  # implicit steps, and the length of each in s
    LENGTH = 0.15  # over which temperature and conductivity vary, in m
    SPACES = 0.022, 0.25  # smallest and largest distance between nodes, in m

    def create(self) -> None:
        pass

    def init_database(self) -> None:
        self.define_training_fields(
            [
                Field("place", ("node", 2), unit="m"),
                Field("triangle", ("triangle", 3), "int64", indexes="node"),
                Field("edge", ("edge", 2), "int64", indexes="node"),
                Field("before", ("node", 2), unit="K, m2/s"),
                Field("after", ("node", 1), unit="K"),
            ]
        )

    def step(self) -> None:
        space = np.exp(self.rng.uniform(*np.log(self.SPACES)))
        nodes, triangles = mesh(str(self.rng.choice(SHAPES)), space, self.rng)
        corners = nodes[triangles]
        sides = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
        areas = (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]) / 2
        parts = sides @ sides.transpose(0, 2, 1) / (4 * areas[:, None, None])
        masses = np.zeros(len(nodes))
        np.add.at(masses, triangles, areas[:, None] / 3)
        distances = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
        alike = np.exp(-((distances / self.LENGTH) ** 2) / 2) + 1e-6 * np.eye(len(nodes))
        fields = np.linalg.cholesky(alike) @ self.rng.standard_normal((len(nodes), 2))
        before, conductivity = fields[:, 0], np.exp(fields[:, 1])
        parts = parts * conductivity[triangles].mean(axis=1)[:, None, None]
        places = np.broadcast_to(triangles[:, :, None], parts.shape)
        ends = places.ravel(), places.swapaxes(1, 2).ravel()
        stiffness = coo_array((parts.ravel(), ends), shape=(len(nodes),) * 2)
        matrix = splu((diags_array(masses) + self.PERIOD * stiffness).tocsc())
        after = before
        for _ in range(self.STEPS):
            after = matrix.solve(masses * after)
        edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, 1:], triangles[:, ::2]]))
        self.set_training_data(
            place=nodes,
            triangle=triangles.astype(np.int64),
            edge=np.unique(edges, axis=0).astype(np.int64),
            before=np.stack([before, conductivity], axis=-1),
            after=after[:, None],
        )
