"""Readings: contacts, images, reactions, motions of bodies, and dynamics of any state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from physx_core.rotations import cross, to_matrix
from physx_core.typing import Records, Vector
from physx_sim import CONTACT, Camera, finite_rows, finite_vector
from physx_sim.engines.checks import integer
from physx_sim.engines.models.reach import Reach
from physx_sim.engines.rays import Caster
from physx_sim.engines.reactions import Reactions
from physx_sim.engines.simulation_core import Engine, SimulationCore
from physx_sim.errors import SimulationError


class ReadableSimulation(SimulationCore[Engine]):
    """What can be read of a world."""

    def contacts(self) -> Records:
        """Return the contacts of the last physics step as a new array of `CONTACT` records."""
        self._check_has("contacts")
        return self.read_contacts() if self._stepped else self._last[1].copy()

    def raycast(self, begins: Vector, ends: Vector, ignored: Sequence[str] = ()) -> Records:
        """Return the first hit of each ray as an array of `RAY_HIT` records.

        Raises:
            SimulationError: If there are not as many start as end points, or a name is unknown.
        """
        self._check_has("raycast")
        first, last = finite_rows("begins", begins, 3), finite_rows("ends", ends, 3)
        if len(first) != len(last):
            raise SimulationError(
                f"There are {len(first)} ray start points but {len(last)} end points."
            )
        if self._caster is None:
            self._caster = Caster(self.parts)
        poses = self._algorithms.body_poses(self.positions(), range(len(self.layout.bodies)))
        poses = np.concatenate([poses, self._scenery.poses])
        passed = [*self._checks.bodies(ignored), *self._hidden]
        return self._caster.cast(first, last, poses, passed)

    def take_images(self, camera: Camera) -> dict[str, Vector]:
        """Return the images of a camera by their names, in the present state."""
        self._check_has("cameras")
        carriers = [camera.body] if camera.body else []
        passed = [*self._checks.bodies([*carriers, *camera.ignored]), *self._hidden]
        position, turn = np.array(camera.position), to_matrix(camera.rotation)
        for x, y, z, *orientation in self.body_poses(carriers).tolist():
            whole = to_matrix(orientation)
            position, turn = whole @ position + (x, y, z), whole @ turn
        return self.draw(camera, position, turn, passed)

    def joint_wrenches(self) -> Vector:
        """Return the joint reactions in the last step, shape (joints, 6)."""
        return self._reactions(self._jointed)

    def link_wrenches(self, names: Sequence[str]) -> Vector:
        """Return the reactions of the joints that lead to links, shape (names, 6).

        Raises:
            SimulationError: If no joint leads to a link, anything is attached, or wheels roll
                without slip.
        """
        self._check_has("joint_wrenches")
        places = self._checks.bodies(names)
        for name, place in zip(names, places, strict=True):
            if place >= len(self._links) or self._is_root(place):
                raise SimulationError(f'No joint leads to "{name}".')
        return self._reactions(places)

    def _is_root(self, body: int) -> bool:
        robot, link = self._links[body]
        return link == 0 and not robot.fixed_base

    def _reactions(self, links: Sequence[int]) -> Vector:
        self._check_has("joint_wrenches")
        if len(self._attachments) or self.parts.rolling:
            raise SimulationError(
                "Reactions of joints need the forces of all attachments and of wheels that roll "
                "without slip, which are not known."
            )
        if self._made_reactions is None:
            self._made_reactions = Reactions(self.parts)
        return self._made_reactions.of(links, self.body_motions(), self._outer(self.positions()))

    def _outer(self, q: Vector) -> dict[int, list[float]]:
        """Return the external forces on bodies in the last step, and torques about origins."""
        found: dict[int, list[float]] = {}
        if not (self._stepped or len(self._last[0])):
            return found
        poses = self._algorithms.body_poses(q, range(len(self.layout.bodies)))
        contacts = self.contacts() if "contacts" in self.features else np.zeros(0, CONTACT)
        for first, second, (x, y, z), force, _, _, torque in contacts.tolist():
            for body, sign in ((first, 1.0), (second, -1.0)):
                if body < len(poses):
                    a, b, c = poses[body, :3].tolist()
                    acting = [sign * part for part in force]
                    _add(found, body, acting, cross(x - a, y - b, z - c, *acting))
                    _add(found, body, (0.0, 0.0, 0.0), [sign * part for part in torque])
        for wrench, force, torque in self._wrenches.before(self._frame):
            body = self._checks.body(wrench.body)
            turn = to_matrix(poses[body, 3:])
            if wrench.frame == "body":
                force, torque = turn @ force, turn @ torque
            arm = turn @ wrench.point
            _add(found, body, force, torque + cross(*arm.tolist(), *force.tolist()))
        return found

    # Bodies and dynamics of any state -------------------------------------------------------

    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of bodies, shape (names, 7): x, y, z and quaternion x, y, z, w."""
        self._check_open()
        q = self.positions() if positions is None else self._checks.positions(positions)
        chosen = self._checks.bodies(names)
        found = self._algorithms.body_poses(q, chosen)
        return self._with_scenery(found, chosen) if self._changes.applied else found

    def _with_scenery(self, found: Vector, bodies: Sequence[int]) -> Vector:
        """Return poses or motions of bodies, with those of static bodies as they are now."""
        scenery = self._scenery
        for row, body in zip(found, bodies, strict=True):
            if (static := body - len(self._links)) >= 0:
                row[:7] = scenery.poses[static]
                row[7:13] = scenery.velocities[static, : len(row) - 7]
        return found

    def body_velocities(
        self,
        names: Sequence[str] | None = None,
        positions: Vector | None = None,
        velocities: Vector | None = None,
    ) -> Vector:
        """Return the velocities of body origins, shape (names, 6): linear, angular."""
        if positions is None and velocities is None:
            return self.body_motions(names)[:, 7:13].copy()
        self._check_open()
        q = self.positions() if positions is None else self._checks.positions(positions)
        v = self.velocities()
        if velocities is not None:
            v = self._checks.velocities("velocities", velocities)
        return self._motions(q, v, np.zeros(self.layout.nv), names)[:, 7:13].copy()

    def _motions(self, q: Vector, v: Vector, a: Vector, names: Sequence[str] | None) -> Vector:
        chosen = self._checks.bodies(names)
        found = self._algorithms.motions(q, v, a, chosen)
        return self._with_scenery(found, chosen) if self._changes.applied else found

    def body_accelerations(self, names: Sequence[str] | None = None) -> Vector:
        """Return the accelerations of body origins, shape (names, 6): linear, angular."""
        return self.body_motions(names)[:, 13:].copy()

    def body_motions(self, names: Sequence[str] | None = None) -> Vector:
        """Return the current poses, velocities, and accelerations of bodies, shape (names, 19)."""
        if self._closed:
            self._check_open()
        return self._motions(self.positions(), self.velocities(), self.accelerations(), names)

    def reach(self, name: str, direction: Vector, positions: Vector | None = None) -> float:
        """Return how far a robot's or object's collision shapes extend along a direction."""
        self._check_open()
        place, along = self._checks.part(name), finite_vector("direction", direction, 3)
        if place not in self._reaches:
            self._reaches[place] = Reach(self.parts.movables[place])
        bodies = self.layout.parts[name].bodies
        q = self.positions() if positions is None else self._checks.positions(positions)
        poses = self._algorithms.body_poses(q, range(bodies.start, bodies.stop))
        return self._reaches[place].along(along, poses)

    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,) in a state."""
        return self._algorithms.forward_dynamics(
            *self._checked_state(positions, velocities, torques=torques)
        )

    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,) in a state."""
        return self._algorithms.inverse_dynamics(
            *self._checked_state(positions, velocities, accelerations=accelerations)
        )

    def mass_matrix(self, positions: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        self._check_open()
        return self._algorithms.mass_matrix(self._checks.positions(positions))

    def jacobian(
        self, body: str, positions: Vector, point: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point on a link or object."""
        self._check_open()
        place, at = self._checks.body(body), finite_vector("point", point, 3)
        return self._algorithms.jacobian(place, self._checks.positions(positions), at)

    def forward_dynamics_derivatives(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return derivatives of `forward_dynamics` w.r.t. positions, velocities, and torques."""
        self._check_has("derivatives")
        return self._algorithms.forward_dynamics_derivatives(
            *self._checked_state(positions, velocities, torques=torques)
        )

    def forward_dynamics_batch(
        self, positions: Vector, velocities: Vector, torques: Vector, *, processes: int = 1
    ) -> Vector:
        """Return `forward_dynamics` for many states, shape (n, nv)."""
        self._check_open()
        processes = integer("processes", processes, 1)
        q, v, tau = self._checks.rows(positions, velocities=velocities, torques=torques)
        return self._algorithms.forward_batch(q, v, tau, processes)

    def forward_dynamics_gradients_batch(
        self,
        positions: Vector,
        velocities: Vector,
        accelerations: Vector,
        weights: Vector,
        *,
        processes: int = 1,
    ) -> Vector:
        """Return gradients of weighted sums of `forward_dynamics`, shape (3, n, nv)."""
        self._check_has("derivatives")
        processes = integer("processes", processes, 1)
        q, v, a, w = self._checks.rows(
            positions, velocities=velocities, accelerations=accelerations, weights=weights
        )
        return self._algorithms.gradients_batch(q, v, a, w, processes)

    def _checked_state(
        self, positions: Any, velocities: Any, **third: Any
    ) -> tuple[Vector, Vector, Vector]:
        self._check_open()
        check = self._checks.velocities
        ((name, values),) = third.items()
        q = self._checks.positions(positions)
        return q, check("velocities", velocities), check(name, values)


def _add(wrenches: dict[int, list[float]], body: int, force: Any, torque: Any) -> None:
    """Add a force and a torque on a body."""
    before = wrenches.get(body, (0.0,) * 6)
    wrenches[body] = [a + b for a, b in zip(before, (*force, *torque), strict=True)]
