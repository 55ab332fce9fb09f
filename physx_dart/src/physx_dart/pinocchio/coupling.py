"""Stepping of robots and objects that touch, or are held together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physx_core.typing import Records
from physx_dart.pinocchio.constraints import constrained
from physx_dart.pinocchio.pairs import PairFinder, PairPoints
from physx_dart.pinocchio.robot import PinocchioRobot
from physx_dart.pinocchio.solver import ImpulseSolver
from physx_dart.pinocchio.ties import Ties
from physx_sim import CONTACT
from physx_sim.engines import Parts
from physx_sim.errors import SimulationError


class Coupling:
    """Steps robots that touch each other's shapes or are held together, those that do as one."""

    def __init__(
        self,
        parts: Parts,
        robots: Sequence[PinocchioRobot],
        solver: ImpulseSolver,
        features: Sequence[str],
    ) -> None:
        """Determine what may touch."""
        self._robots, self._solver, self._period = robots, solver, parts.world.period
        self.finder = PairFinder(parts, robots, features)
        self._touching: PairPoints | None = None
        self._impulses = np.zeros((0, 3))
        self.ties = Ties(robots, parts.world)
        # Impulses of pairs in the last step, in the world frame, which warm-start the next one.
        self._warmth = np.zeros((len(self.finder), 3))

    def __bool__(self) -> bool:
        """Return whether any pair of shapes may touch, or anything is held together."""
        return len(self.finder) > 0 or bool(self.ties)

    def clear_warm_start(self) -> None:
        """Discard the impulses of the last step."""
        self._warmth.fill(0.0)

    def step(self) -> None:
        """Simulate one step of all robots."""
        free = [robot.free_velocities() for robot in self._robots]
        touching = self.finder.find(free, self._period) if len(self.finder) else None
        self._touching = touching
        coupled = sorted(self.ties.robots | (set() if touching is None else touching.robots))
        for place, robot in enumerate(self._robots):
            if place not in coupled:
                robot.finish(robot.constrained(free[place]))
        if not coupled:
            self.clear_warm_start()
            return
        group = [self._robots[place] for place in coupled]
        contacts, warm = None, None
        if touching is not None:
            contacts = touching.contacts
            wide = [contacts.jacobian[:, self.finder.columns[place]] for place in coupled]
            contacts.jacobian = np.concatenate(wide, axis=1)
            if contacts.spins is not None:
                whole = contacts.spins.jacobian
                wide = [whole[:, self.finder.columns[place]] for place in coupled]
                contacts.spins.jacobian = np.concatenate(wide, axis=1)
            share = self._warmth[touching.pairs] / np.bincount(touching.pairs)[touching.pairs, None]
            warm = np.einsum("kij,kj->ki", contacts.axes, share)
        ties = self.ties.rows(coupled) if self.ties else None
        parts = [
            self._robots[place].constraints(
                free[place], touched=True, tied=place in self.ties.robots
            )
            for place in coupled
        ]
        after, self._impulses = constrained(
            parts,
            np.concatenate([robot.native()[1] for robot in group]),
            np.concatenate([free[place] for place in coupled]),
            self._period,
            self._solver,
            contacts,
            warm,
            ties,
        )
        self.clear_warm_start()
        if touching is not None:
            along = np.einsum("kij,ki->kj", touching.contacts.axes, self._impulses)
            np.add.at(self._warmth, touching.pairs, along)
        first = 0
        for robot in group:
            robot.finish(after[first : first + robot.nv])
            first += robot.nv

    def groups(self) -> list[list[PinocchioRobot]]:
        """Return the robots whose constraints were solved together in the last step.

        Raises:
            SimulationError: If shapes touched.
        """
        if self._touching is not None:
            raise SimulationError(
                "A step has no derivatives where shapes of bodies touch each other or a static "
                "object: points and normals of such contacts jump. Use the ground instead."
            )
        coupled = [self._robots[place] for place in sorted(self.ties.robots)]
        alone = [[robot] for robot in self._robots if robot not in coupled]
        return [*alone, *([coupled] if coupled else [])]

    def contacts(self) -> Records:
        """Return the contacts between shapes in the last step."""
        touching = self._touching
        if touching is None:
            return np.zeros(0, CONTACT)
        first, second = touching.bodies.T
        return touching.contacts.records(first, second, self._impulses, self._period)
