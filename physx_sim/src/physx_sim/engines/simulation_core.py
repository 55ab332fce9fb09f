"""Base of simulations with engines: their parts, and what an engine implements for all of them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Generic, TypeVar

import numpy as np

from physx_core.typing import Index, Records, Vector
from physx_sim import CONTACT, FEATURES, Camera, Simulation, StepDerivatives, copy_to
from physx_sim.engines.algorithms import Algorithms
from physx_sim.engines.attachments import Attachments, Bond
from physx_sim.engines.changes import Changes, Scenery
from physx_sim.engines.checks import LayoutChecks
from physx_sim.engines.engine import RobotEngine
from physx_sim.engines.influences import Hooks, Wrenches
from physx_sim.engines.models.parts import Parts, layout_of
from physx_sim.engines.models.reach import Reach
from physx_sim.engines.rays import Caster
from physx_sim.engines.reactions import Reactions
from physx_sim.errors import SimulationError

NOTHING = np.zeros(0), np.zeros(0, CONTACT)
"""What is measured before the first step."""

Engine = TypeVar("Engine", bound=RobotEngine)


class SimulationCore(Simulation, Generic[Engine]):
    """The parts of a world, its state, and the methods that an engine overrides."""

    lacks: ClassVar[frozenset[str]] = frozenset()
    """Features that the engine never supports."""
    caveats: ClassVar[Mapping[str, str]] = {}
    """What is limited in features that it has; both make the table in docs/engines.md."""
    _attachments: Attachments

    def __init__(self, parts: Parts, robots: Sequence[Engine], lacks: Sequence[str]) -> None:
        """Put the robots at rest in their neutral configuration.

        Args:
            parts: Everything in the world.
            robots: One for each movable of the world.
            lacks: Features that this simulation lacks.
        """
        self.features = frozenset(FEATURES) - self.lacks - set(lacks)
        self.parts = parts
        self.period = parts.world.period
        self.layout = layout_of(parts)
        self._checks = LayoutChecks(self.layout)
        self._robots = tuple(robots)
        self._only = robots[0] if len(robots) == 1 else None
        self._joint_count = len(self.layout.joints)
        self._closed = self._stepped = self._stepping = False
        self._last: tuple[Vector, Records] = NOTHING
        self._frame = 0
        places = self.layout.parts.values()
        self._slices = [
            (robot, place.positions, place.velocities)
            for robot, place in zip(robots, places, strict=True)
        ]
        self._joints = [place.joints for place in places]
        self._links = [(robot, link) for robot in robots for link in range(len(robot.model.links))]
        self._made_algorithms: Algorithms | None = None
        self._caster: Caster | None = None
        self._made_reactions: Reactions | None = None
        carried = [body for movable in parts.movables for body in movable.model.bodies]
        self._jointed = [place for place, body in enumerate(carried) if body.joint is not None]
        self._reaches: dict[int, Reach] = {}
        for robot in robots:
            robot.write(robot.neutral(), np.zeros(robot.nv))
        self._wrenches, self._hooks = Wrenches(self.period), Hooks()
        self._changes, self._scenery = Changes(parts, self.layout), Scenery.of(parts)
        self._movers: list[int] = []
        self._hidden: list[int] = []
        self._frozen: dict[int, tuple[Vector, Vector]] = {}
        self._positioned: Index = np.zeros(0, np.intp)  # joints that track position commands

    # Of the engine --------------------------------------------------------------------------

    @abstractmethod
    def advance(self, n: int) -> None:
        """Simulate n physics steps."""

    @abstractmethod
    def make_algorithms(self) -> Algorithms:
        """Return the algorithms for any state of the world; called on first use."""

    @abstractmethod
    def read_contacts(self) -> Records:
        """Return the contacts of the last physics step."""

    def clear_warm_start(self) -> None:
        """Clear what the engine keeps from earlier steps, so that only the state matters."""

    def change_gravity(self, gravity: tuple[float, ...]) -> None:
        """Change the gravity in the engine; feature `gravity`."""
        raise self._lacks("gravity")

    def change_parts(self, before: Parts) -> None:
        """Take over masses, friction, and ground of `parts`; feature `changes`.

        Args:
            before: The parts that the engine has; what did not change is the same object.
        """
        raise self._lacks("changes")

    def hide(self, bodies: Sequence[int]) -> None:
        """Let bodies, given as indices into `Layout.names`, touch nothing, and all others touch.

        Moving objects among them are left where they are after each block of steps. Feature
        `changes`.
        """
        raise self._lacks("changes")

    def place_static(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body, given by its index, for the next step; feature `moving_statics`.

        Args:
            static: Index into `Layout.statics`.
            pose: Position in m, quaternion x, y, z, w, shape (7,); must not be kept.
            velocity: Velocity in the world frame, in m/s, then rad/s, shape (6,); likewise.
            surface: Velocity of its surface along itself, in its frame, in m/s, shape (3,).
        """
        raise self._lacks("moving_statics")

    def bind(self, number: int, bond: Bond) -> None:
        """Hold two bodies together until `unbind`; feature `attachments`."""
        raise self._lacks("attachments")

    def unbind(self, number: int) -> None:
        """Stop holding two bodies together, given the number from `bind`."""
        raise self._lacks("attachments")

    def draw(
        self, camera: Camera, position: Vector, turn: Vector, passed: Sequence[int]
    ) -> dict[str, Vector]:
        """Return the images of a camera; called only if the engine has the feature ``cameras``.

        Args:
            camera: The camera.
            position: Its position in the world, shape (3,), in m.
            turn: Its axes in the world, as columns, shape (3, 3).
            passed: Bodies that it does not see, as indices into `Layout.names`.
        """
        raise self._lacks("cameras")

    def derivatives_of_step(self) -> StepDerivatives:
        """Return the derivatives of the last physics step; feature `step_derivatives`.

        Raises:
            SimulationError: If it has none; the message names the reason.
        """
        raise self._lacks("step_derivatives")

    # State ----------------------------------------------------------------------------------

    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), copied to `out` if given."""
        if self._closed:
            self._check_open()
        only = self._only
        found = only.positions() if only else _join([robot.positions() for robot in self._robots])
        return found if out is None else copy_to(found, out)

    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), copied to `out` if given."""
        if self._closed:
            self._check_open()
        only = self._only
        found = only.velocities() if only else _join([each.velocities() for each in self._robots])
        return found if out is None else copy_to(found, out)

    def accelerations(self) -> Vector:
        """Return the velocity change in the last step divided by the period, shape (nv,)."""
        if self._closed:
            self._check_open()
        if not self._stepped:
            found = self._last[0]
            return found.copy() if len(found) else np.zeros(self.layout.nv)
        only = self._only
        if only and not self._frozen:
            return only.accelerations()
        found = _join([robot.accelerations() for robot in self._robots])
        for place in self._frozen:
            found[self._slices[place][2]] = 0.0
        return found

    def _watch(self) -> None:
        """Note whether any work is needed between steps."""
        self._watched = bool(
            len(self._hooks)
            or len(self._wrenches)
            or len(self._positioned)
            or self._movers
            or self._frozen
        )

    @property
    def _algorithms(self) -> Algorithms:
        if self._made_algorithms is None:
            self._check_open()
            self._made_algorithms = self.make_algorithms()
        return self._made_algorithms

    def _check_has(self, feature: str) -> None:
        self._check_open()
        if feature not in self.features:
            raise self._lacks(feature)

    def _check_open(self) -> None:
        if self._closed:
            raise SimulationError("The simulation is closed; build a new one.")


def _join(parts: Sequence[Vector]) -> Vector:
    """Concatenate vectors."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
