"""Attachments: what holds two bodies together that no joint connects."""

from __future__ import annotations

from dataclasses import dataclass

from physx_core import checks
from physx_core.errors import ConfigError


@dataclass(frozen=True)
class Attachment:
    """Options common to `Weld` and `Connect`. Attached bodies still collide with each other.

    Attributes:
        body_a: Name of a link, object, or static body, as in `Layout.names`.
        body_b: Name of the other; empty: the world.

    Raises:
        ConfigError: If it is neither of the two, a name is missing, or both are the same.
    """

    body_a: str
    body_b: str = ""

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if type(self) is Attachment:
            raise ConfigError("Attachment is not a kind of attachment; use Weld or Connect.")
        for option in ("body_a", "body_b"):
            if not isinstance(getattr(self, option), str):
                raise ConfigError(f"{kind}.{option} is {getattr(self, option)!r}, not a name.")
        if not self.body_a or self.body_a == self.body_b:
            raise ConfigError(f"{kind} needs two bodies, not {self.body_a!r} and {self.body_b!r}.")
        checks.store_declared(f'{kind} of "{self.body_a}": ', self)


@dataclass(frozen=True)
class Weld(Attachment):
    """Holds a body where it is relative to another, like glue, a gripper, or a suction cup.

    Attributes:
        position: Position of body_b in the frame of body_a, in m; None: as they are when attached.
        orientation: Its orientation there: quaternion x, y, z, w; None: as they are when attached.
    """

    position: tuple[float, ...] | None = None
    orientation: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f'Weld of "{self.body_a}": '
        if self.position is not None:
            position = checks.vector(f"{where}position", self.position, 3)
            object.__setattr__(self, "position", position)
        if self.orientation is not None:
            orientation = checks.unit_quaternion(f"{where}orientation", self.orientation)
            object.__setattr__(self, "orientation", orientation)


@dataclass(frozen=True)
class Connect(Attachment):
    """Holds a point of a body at a point of another, like a ball joint; it closes loops.

    Attributes:
        point_a: Point in the frame of body_a, in m.
        point_b: Point in the frame of body_b, in m; None: where point_a is when attached.
    """

    point_a: tuple[float, ...] = (0.0, 0.0, 0.0)
    point_b: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f'Connect of "{self.body_a}": '
        object.__setattr__(self, "point_a", checks.vector(f"{where}point_a", self.point_a, 3))
        if self.point_b is not None:
            object.__setattr__(self, "point_b", checks.vector(f"{where}point_b", self.point_b, 3))
