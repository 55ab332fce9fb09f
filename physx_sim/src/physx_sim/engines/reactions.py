"""Reactions of joints, fixed ones included, from the motion of the links that they carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from physx_core.rotations import cross_rows, to_matrix_rows
from physx_core.typing import Vector
from physx_sim.engines.models.parts import Parts
from physx_sim.engines.models.rigid_bodies import RigidBody


class Reactions:
    """The links of a world, prepared for the reactions of the joints that lead to them."""

    def __init__(self, parts: Parts) -> None:
        bodies, first, parents = list[RigidBody](), 0, list[int]()
        for movable in parts.movables:
            bodies += movable.model.bodies
            parents += [first + b.parent if b.parent >= 0 else -1 for b in movable.model.bodies]
            first += len(movable.model.bodies)
        self._gravity = np.array(parts.world.gravity)
        self._masses = np.array([body.mass for body in bodies])
        self._centers = np.array([body.center for body in bodies])
        self._inertias = np.array([body.inertia for body in bodies])
        self._carried = np.eye(len(bodies))  # whether a link (row) carries another one (column)
        for link in reversed(range(len(bodies))):
            if parents[link] >= 0:
                self._carried[parents[link]] += self._carried[link]

    def of(
        self, links: Sequence[int], motions: Vector, outer: Mapping[int, Sequence[float]]
    ) -> Vector:
        """Return the wrench on each link from its parent, shape (links, 6): force, torque.

        They are at the link's origin and in its frame.

        Args:
            links: Indices of the links.
            motions: Motions of all links, as from `Simulation.body_motions`, shape (n, 19).
            outer: External wrenches by link: force, then torque about the link's origin, 6 numbers
                in the world frame.
        """
        turns, spins, turning = to_matrix_rows(motions[:, 3:7]), motions[:, 10:13], motions[:, 16:]
        arms = (turns @ self._centers[..., None])[..., 0]
        inertias = turns @ self._inertias @ turns.transpose(0, 2, 1)
        pace = motions[:, 13:16] + cross_rows(turning, arms)
        pace += cross_rows(spins, cross_rows(spins, arms)) - self._gravity
        forces = self._masses[:, None] * pace
        spinning = (inertias @ spins[..., None])[..., 0]
        torques = (inertias @ turning[..., None])[..., 0] + cross_rows(spins, spinning)
        torques += cross_rows(arms, forces)
        for link, wrench in outer.items():
            forces[link] -= wrench[:3]
            torques[link] -= wrench[3:]
        torques += cross_rows(motions[:, :3], forces)  # about the origin of the world
        carried = self._carried[links]
        force, torque = carried @ forces, carried @ torques
        torque -= cross_rows(motions[links, :3], force)
        found = np.concatenate([force[:, None] @ turns[links], torque[:, None] @ turns[links]], 2)
        return np.array(found[:, 0])
