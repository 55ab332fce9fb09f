"""Robots and objects as one state: reading it, and the dynamics of any state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from physx_core.errors import SimulationError, listed, nearest
from physx_core.simulation import Simulation, finite_rows, finite_vector, written
from physx_core.typing import Vector
from physx_dart.pinocchio.reaching import Reach
from physx_dart.shared.checks import integer, joined
from physx_dart.shared.engine import RobotEngine
from physx_dart.shared.parts import Parts, layout_of, static_poses

if TYPE_CHECKING:
    from physx_dart.batch.processes import SharedBatches
    from physx_dart.shared.algorithms import Algorithms


class WorldState(Simulation):
    """The state of a world, each robot and object in a `RobotEngine`."""

    def __init__(self, parts: Parts, robots: Sequence[RobotEngine]) -> None:
        """Keep the robots and put them at rest in their neutral configuration.

        Args:
            parts: All of the world.
            robots: Of each mover of the world.
        """
        self.parts = parts
        self.period = parts.world.period
        self.layout = layout_of(parts)
        self._robots = tuple(robots)
        self._only = robots[0] if len(robots) == 1 else None
        self._joint_count = len(self.layout.joints)
        self._closed = self._stepped = False
        places = self.layout.parts.values()
        self._q = [place.positions for place in places]
        self._v = [place.velocities for place in places]
        self._joints = [place.joints for place in places]
        self._bodies = {
            name: (robot, link)
            for robot, place in zip(robots, places, strict=True)
            for link, name in enumerate(self.layout.bodies[place.bodies])
        }
        self._places = {name: i for i, name in enumerate(self.layout.names)}
        self._static_poses = static_poses(parts)
        self._made_algorithms: Algorithms | None = None
        self._made_batches: SharedBatches | None = None
        self._reaches: dict[int, Reach] = {}
        for robot in robots:
            robot.write(robot.neutral(), np.zeros(robot.nv))

    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), written into `out` if it is given."""
        if self._closed:
            self._check_open()
        only = self._only
        found = only.positions() if only else joined([robot.positions() for robot in self._robots])
        return found if out is None else written(found, out)

    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), written into `out` if it is given."""
        if self._closed:
            self._check_open()
        only = self._only
        found = only.velocities() if only else joined([each.velocities() for each in self._robots])
        return found if out is None else written(found, out)

    def accelerations(self) -> Vector:
        """Return the change of the velocities in the last step by the period, shape (nv,)."""
        if self._closed:
            self._check_open()
        if not self._stepped:
            return np.zeros(self.layout.nv)
        only = self._only
        return only.accelerations() if only else joined([r.accelerations() for r in self._robots])

    # Bodies and dynamics of any state -------------------------------------------------------

    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of bodies, shape (names, 7): x, y, z and quaternion x, y, z, w."""
        if positions is None:
            return self._algorithms.body_poses(self.positions(), self._chosen(names))
        self._check_open()
        q = self._checked_positions(positions)
        rows = joined([r.poses(q[part]) for r, part in zip(self._robots, self._q, strict=True)])
        return np.concatenate([rows, self._static_poses])[self._chosen(names)]

    def body_velocities(
        self,
        names: Sequence[str] | None = None,
        positions: Vector | None = None,
        velocities: Vector | None = None,
    ) -> Vector:
        """Return the velocities of bodies' origins, shape (names, 6): linear, angular."""
        if positions is None and velocities is None:
            return self.body_motions(names)[:, 7:13].copy()
        self._check_open()
        q = self.positions() if positions is None else self._checked_positions(positions)
        v = self.velocities()
        if velocities is not None:
            v = finite_vector("velocities", velocities, self.layout.nv)
        chosen = self._chosen(names)
        nothing = np.zeros(self.layout.nv)
        return self._algorithms.motions(q, v, nothing, chosen)[:, 7:13].copy()

    def body_accelerations(self, names: Sequence[str] | None = None) -> Vector:
        """Return the accelerations of bodies' origins, shape (names, 6): linear, angular."""
        return self.body_motions(names)[:, 13:].copy()

    def body_motions(self, names: Sequence[str] | None = None) -> Vector:
        """Return poses, velocities and accelerations of bodies at present, shape (names, 19)."""
        if self._closed:
            self._check_open()
        q, v, a = self.positions(), self.velocities(), self.accelerations()
        return self._algorithms.motions(q, v, a, self._chosen(names))

    def reach(self, name: str, direction: Vector, positions: Vector | None = None) -> float:
        """Return how far the collision shapes of a robot or object reach along a direction."""
        self._check_open()
        known = list(self.layout.parts)
        if name not in known:
            raise SimulationError(
                f'There is no robot or object "{name}" that moves.{nearest(str(name), known)} '
                f"There are: {listed(known)}."
            )
        place, along = known.index(name), finite_vector("direction", direction, 3)
        if place not in self._reaches:
            self._reaches[place] = Reach(self.parts.movers[place])
        q = self.positions() if positions is None else self._checked_positions(positions)
        return self._reaches[place].along(along, self._robots[place].poses(q[self._q[place]]))

    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) cause in a state."""
        q, v, tau = self._dynamic_state(positions, velocities, "torques", torques)
        return joined([r.forward(q[a], v[b], tau[b]) for r, a, b in self._slices()])

    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that cause accelerations (nv,) in a state."""
        q, v, x = self._dynamic_state(positions, velocities, "accelerations", accelerations)
        return joined([r.inverse(q[a], v[b], x[b]) for r, a, b in self._slices()])

    def mass_matrix(self, positions: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        self._check_open()
        return self._algorithms.mass_matrix(self._checked_positions(positions))

    def jacobian(
        self, body: str, positions: Vector, point: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point of a link or object."""
        self._check_open()
        place = self._place(body)
        at = finite_vector("point", point, 3)
        q = self._checked_positions(positions)
        if place >= len(self.layout.bodies):
            return np.zeros((6, self.layout.nv))
        return self._algorithms.jacobian(place, q, at)

    def forward_dynamics_derivatives(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward_dynamics` by positions, velocities and torques."""
        q, v, tau = self._dynamic_state(positions, velocities, "torques", torques)
        return self._algorithms.forward_dynamics_derivatives(q, v, tau)

    def forward_dynamics_batch(
        self, positions: Vector, velocities: Vector, torques: Vector, *, processes: int = 1
    ) -> Vector:
        """Return `forward_dynamics` of many states, shape (n, nv), by Pinocchio's algorithms."""
        processes = integer("processes", processes, 1)
        q, others = self._many_states(positions, velocities=velocities, torques=torques)
        return self._batches.forward(q, *others, processes=processes)

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
        processes = integer("processes", processes, 1)
        q, others = self._many_states(
            positions, velocities=velocities, accelerations=accelerations, weights=weights
        )
        return self._batches.gradients(q, *others, processes=processes)

    @property
    def _batches(self) -> SharedBatches:
        if self._made_batches is None:
            from physx_dart.batch.batches import Batches, MoverBatches
            from physx_dart.batch.processes import SharedBatches

            movers = [MoverBatches(x.model, x.resistance) for x in self._algorithms.movers]
            self._made_batches = SharedBatches(Batches(movers))
        return self._made_batches

    @property
    def _algorithms(self) -> Algorithms:
        if self._made_algorithms is None:
            from physx_dart.shared.algorithms import Algorithms  # its library loads slowly

            self._made_algorithms = Algorithms(self.parts)
        return self._made_algorithms

    # Checks ---------------------------------------------------------------------------------

    def _slices(self) -> list[tuple[RobotEngine, slice, slice]]:
        return list(zip(self._robots, self._q, self._v, strict=True))

    def _dynamic_state(
        self, positions: Any, velocities: Any, name: str, third: Any
    ) -> tuple[Vector, Vector, Vector]:
        self._check_open()
        nv = self.layout.nv
        q = self._checked_positions(positions)
        return q, finite_vector("velocities", velocities, nv), finite_vector(name, third, nv)

    def _place(self, name: Any) -> int:
        place = self._places.get(name) if isinstance(name, str) else None
        if place is None:
            raise SimulationError(
                f'There is no link "{name}".{nearest(str(name), self._places)} '
                f"Links: {listed(self._places)}."
            )
        return place

    def _chosen(self, names: Any) -> list[int]:
        """Return the places of bodies in `Layout.names`; None: all that move."""
        if names is None:
            return list(range(len(self.layout.bodies)))
        if isinstance(names, str):
            raise SimulationError(f'names is the text "{names}" but must be a list of names.')
        try:
            return [self._places[name] for name in names]
        except (KeyError, TypeError):
            pass
        try:
            return [self._place(name) for name in names]
        except TypeError:
            raise SimulationError(f"names is {names!r} but must be a list of names.") from None

    def _check_open(self) -> None:
        if self._closed:
            raise SimulationError("The simulation is closed; build a new one.")

    def _checked_positions(self, positions: Any) -> Vector:
        q = finite_vector("positions", positions, self.layout.nq)
        for place in self.layout.parts.values():
            if place.floating:
                base = slice(place.positions.start + 3, place.positions.start + 7)
                length = math.hypot(*q[base].tolist())
                if not abs(length - 1.0) <= 1e-3:
                    raise SimulationError(
                        f'The quaternion of "{place.name}" (positions {base.start} to '
                        f"{base.stop - 1}, in the order x, y, z, w) has length {length:g}, not 1."
                    )
                q[base] /= length
        return q

    def _many_states(self, positions: Any, **others: Any) -> tuple[Vector, list[Vector]]:
        """Return positions (n, nq) with unit quaternions, and others (n, nv) by their names."""
        self._check_open()
        q, nv = finite_rows("positions", positions, self.layout.nq), self.layout.nv
        rows = [finite_rows(name, values, nv) for name, values in others.items()]
        if any(len(each) != len(q) for each in rows):
            counts = (f"{len(each)} {name}" for name, each in zip(others, rows, strict=True))
            raise SimulationError(
                f"There are {len(q)} positions, {', '.join(counts)}; each state needs one row of "
                "each."
            )
        for place in self.layout.parts.values():
            if place.floating:
                quaternions = q[:, place.positions.start + 3 : place.positions.start + 7]
                lengths = np.sqrt((quaternions**2).sum(axis=1, keepdims=True))
                if not (np.abs(lengths - 1.0) <= 1e-3).all():
                    raise SimulationError(
                        f'A quaternion of "{place.name}" (x, y, z, w) has length '
                        f"{lengths[np.argmax(np.abs(lengths - 1.0))].item():g}, not 1."
                    )
                quaternions /= lengths
        return q, rows
