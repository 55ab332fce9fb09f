"""The world: robots, objects, the ground, and the options of their simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from physx_core import checks
from physx_core.errors import ConfigError, UnknownOptionError
from physx_sim.description.attachment import Attachment
from physx_sim.description.ground import Ground, HeightField, Stairs
from physx_sim.description.objects import WorldObject
from physx_sim.description.robot import Robot

Contacts = Literal["all", "static", "none"]
Integrator = Literal["euler", "rk4"]


@dataclass(frozen=True)
class World:
    """Description of everything in a simulation.

    Attributes:
        robots: The robots.
        period: Length of one physics step, in s.
        gravity: Acceleration of free fall in the world frame, in m/s².
        objects: Boxes, spheres, and the like; names must be unique among robots and objects.
        ground: `Ground`, `Stairs`, or `HeightField`; None: no ground.
        attachments: What holds bodies together, as of the start: `Weld`, `Connect`.
        contacts: Which contacts to simulate: ``"all"``; ``"static"``, only between moving and
            static bodies; ``"none"``.
        integrator: ``"euler"``, semi-implicit, which every engine supports, or ``"rk4"``, of fourth
            order, for robots without contacts, limits, or friction.
        detector: Name of the engine's collision detector; None: its default.
        solver: Name of the engine's contact solver; None: its default.
        iterations: Maximum number of iterations of an iterative solver per step; None: its default.
            Fewer are faster where they suffice, and less accurate for impacts and piles. Ignored by
            engines that solve contacts exactly.

    Raises:
        UnknownOptionError: If there is no such choice of `contacts` or `integrator`.
        ConfigError: If a robot, object, attachment, or ground has the wrong type, a name is used
            twice, nothing can move, or another option is out of range.
    """

    robots: Sequence[Robot] = ()
    period: float = 1e-3
    gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
    objects: Sequence[WorldObject] = ()
    ground: Ground | Stairs | HeightField | None = None
    attachments: Sequence[Attachment] = ()
    contacts: Contacts = "all"
    integrator: Integrator = "euler"
    detector: str | None = None
    solver: str | None = None
    iterations: int | None = None

    def __post_init__(self) -> None:
        kinds: tuple[tuple[str, type], ...]
        kinds = (("robots", Robot), ("objects", WorldObject), ("attachments", Attachment))
        for option, kind in kinds:
            found = checks.things(f"World.{option}", getattr(self, option), kind)
            object.__setattr__(self, option, found)
        names = [robot.name for robot in self.robots] + [thing.name for thing in self.objects]
        if len(set(names)) != len(names) or "ground" in names:
            raise ConfigError(
                f"Robots and objects of a world need distinct names, not {names}; "
                'the name "ground" is reserved.'
            )
        if not self.robots and all(thing.static for thing in self.objects):
            raise ConfigError("A world needs a robot or a moving object.")
        if self.ground is not None and not isinstance(self.ground, (Ground, Stairs, HeightField)):
            raise ConfigError(
                f"World.ground is {self.ground!r}, not Ground, Stairs, or HeightField."
            )
        checks.store_declared("World.", self)
        checks.positive("World.period", self.period)
        if self.iterations is not None and self.iterations < 1:
            raise ConfigError(f"World.iterations is {self.iterations!r}, not a positive integer.")
        object.__setattr__(self, "gravity", checks.vector("World.gravity", self.gravity, 3))
        for option, known in (
            ("contacts", get_args(Contacts)),
            ("integrator", get_args(Integrator)),
        ):
            value = getattr(self, option)
            if value not in known:
                raise UnknownOptionError(f"World.{option}", [str(value)], known)
