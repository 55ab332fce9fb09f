"""The engine Pinocchio: its algorithms and constraint solvers, stepped by `PinocchioRobot`.

All calls to pinocchio are in `physx_dart.pinocchio` and `physx_dart.batch`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from physx_core.typing import Records, Vector
from physx_dart.batch.processes import ParallelAlgorithms
from physx_dart.pinocchio.coupling import Coupling
from physx_dart.pinocchio.derivatives import GroupDerivatives
from physx_dart.pinocchio.robot import PinocchioRobot
from physx_dart.pinocchio.solver import ImpulseSolver
from physx_sim import FEATURES, Simulation, StepDerivatives, World
from physx_sim.engines import (
    RK4_LACKS,
    Algorithms,
    Bond,
    Parts,
    RobotBackend,
    RobotSimulation,
    check_rk4,
    read_parts,
)
from physx_sim.errors import FeatureNotSupportedError


class PinocchioBackend(RobotBackend):
    """Pinocchio, a library of rigid-body algorithms.

    Contact solvers: ``pgs`` (default) and ``admm``, both with a friction cone, for problems that
    Newton's method does not solve. Contacts with planes and height fields are found from points and
    spheres (`physx_dart.pinocchio.contacts`), contacts between shapes by coal
    (`physx_dart.pinocchio.pairs`); there is no choice of detector.
    """

    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation; it is deterministic, so the seed has no effect.

        Raises:
            ModelError: If a robot or mesh cannot be loaded; the message gives the reason.
            FeatureNotSupportedError: If the world needs a feature that the engine does not have.
            UnknownOptionError: If there is no solver with that name.
        """
        return PinocchioSimulation(world)


class PinocchioSimulation(RobotSimulation[PinocchioRobot]):
    """A world in Pinocchio."""

    engine = "pinocchio"
    lacks: ClassVar[frozenset[str]] = frozenset({"cameras", "mesh_contacts"})
    caveats: ClassVar[Mapping[str, str]] = {
        "joint_wrenches": "not while anything is attached, or wheels roll without slip",
        "step_derivatives": "not where shapes touch: [gradients](contacts.md#gradients)",
    }

    def __init__(self, world: World) -> None:
        """Build the world; raises the same errors as the backend's `build`."""
        solver = ImpulseSolver(world.solver or "pgs")
        parts = read_parts(world)
        self._check_features(parts)
        statics = [] if world.contacts == "none" else parts.statics
        features = sorted(frozenset(FEATURES) - self.lacks)
        robots = [
            PinocchioRobot(movable, world, statics, solver, features) for movable in parts.movables
        ]
        self._coupling = Coupling(parts, robots, solver, features)
        super().__init__(parts, robots, () if world.integrator == "euler" else RK4_LACKS)

    def _check_features(self, parts: Parts) -> None:
        world, features = parts.world, frozenset(FEATURES) - self.lacks
        if world.detector is not None:
            raise FeatureNotSupportedError(self.engine, f"detector {world.detector}", features)
        if world.integrator == "rk4":
            check_rk4(parts, self.engine, features)

    def make_algorithms(self) -> Algorithms:
        """Return Pinocchio's algorithms."""
        return ParallelAlgorithms.of_parts(self.parts)

    def advance(self, n: int) -> None:
        """Simulate n physics steps."""
        if self._coupling:
            for _ in range(n):
                self._coupling.step()
            return
        for robot in self._robots:
            robot.run(n)

    def derivatives_of_step(self) -> StepDerivatives:
        """Return the derivatives of the last physics step.

        Raises:
            SimulationError: If it has none.
        """
        groups = self._coupling.groups() if self._coupling else [[each] for each in self._robots]
        nv, joints = self.layout.nv, len(self.layout.joints)
        state, commands = np.zeros((2 * nv, 2 * nv)), np.zeros((2 * nv, joints))
        parts = dict(zip(self._robots, self.layout.parts.values(), strict=True))
        for group in groups:
            found = GroupDerivatives(group, self.period).in_layout()
            if len(group) == len(self._robots):
                return found
            own = np.concatenate([np.arange(nv)[parts[robot].velocities] for robot in group])
            driven = np.concatenate([np.arange(joints)[parts[robot].joints] for robot in group])
            rows = np.concatenate([own, nv + own])
            state[np.ix_(rows, rows)] = found.state
            commands[np.ix_(rows, driven)] = found.commands
        return StepDerivatives(state, commands)

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the gravity of all robots and objects."""
        for robot in self._robots:
            robot.change_gravity(gravity)

    def change_parts(self, before: Parts) -> None:
        """Take over masses, friction, and ground."""
        statics = [] if before.world.contacts == "none" else self.parts.statics
        for robot, old, new in zip(self._robots, before.movables, self.parts.movables, strict=True):
            if new.model.bodies != old.model.bodies:
                robot.change_masses(new)
            robot.contact_finder.take_materials(new, statics if new.moves else ())
        self._coupling.finder.take_materials(self.parts)

    def hide(self, bodies: Sequence[int]) -> None:
        """Let only bodies that are not among these touch."""
        for robot, part in zip(self._robots, self.layout.parts.values(), strict=True):
            robot.contact_finder.hidden = part.bodies.start in bodies
        self._coupling.finder.hide(bodies)

    def place_static(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body for the next step."""
        for robot in self._robots:
            robot.contact_finder.move_surface(static, surface)
        self._coupling.finder.place_static(static, pose, velocity, surface)
        if self.parts.statics[static].name == "ground":
            self._coupling.ties.move_ground(surface)

    def bind(self, number: int, bond: Bond) -> None:
        """Hold two bodies together until `unbind`."""
        self._coupling.ties.bind(number, bond)

    def unbind(self, number: int) -> None:
        """Stop holding two bodies together."""
        self._coupling.ties.unbind(number)

    def clear_warm_start(self) -> None:
        """Make the state alone determine what follows: discard the impulses of the last step."""
        self._coupling.clear_warm_start()
        for robot in self._robots:
            robot.clear_warm_start()

    def read_contacts(self) -> Records:
        """Return the contacts of the last physics step."""
        first, statics = 0, len(self.layout.bodies)
        found = [self._coupling.contacts()]
        for robot in self._robots:
            found.append(robot.contacts(first, statics))
            first += len(robot.model.links)
        return np.concatenate(found)
