"""Objects of a world: single bodies with one shape."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from physx_core import checks
from physx_core.errors import ConfigError
from physx_sim.description.ground import MATERIAL


@dataclass(frozen=True, kw_only=True)
class WorldObject:
    """Options common to all objects. The shape's center is its center of mass.

    Attributes:
        name: Name of the object in the world, and of its body in the state.
        mass: In kg, at uniform density.
        static: Whether it never moves; its mass then has no effect.
        position: Initial position of its center, in m.
        orientation: Initial orientation: quaternion x, y, z, w.
        friction: Coefficient of friction; a contact uses the smaller of the two.
        restitution: Coefficient of restitution; a contact uses the product of the two.
        torsional_friction: Friction torque about the normal of a contact per normal force, in m; a
            contact uses the larger of the two.
        rolling_friction: Friction torque against rolling per normal force, in m; a contact uses the
            larger of the two.
    """

    lengths: ClassVar[tuple[str, ...]] = ()
    """Names of the options that must be positive lengths."""

    name: str
    mass: float = 1.0
    static: bool = False
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    orientation: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    friction: float = 1.0
    restitution: float = 0.0
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0

    def __post_init__(self) -> None:
        kind = type(self).__name__
        checks.name(kind.lower(), self.name)
        where = f'{kind} "{self.name}": '
        checks.store_declared(where, self)
        checks.options(checks.positive, where, self, "mass", *self.lengths)
        object.__setattr__(self, "position", checks.vector(f"{where}position", self.position, 3))
        orientation = checks.unit_quaternion(f"{where}orientation", self.orientation)
        object.__setattr__(self, "orientation", orientation)
        checks.options(checks.not_negative, where, self, *MATERIAL)


@dataclass(frozen=True, kw_only=True)
class Box(WorldObject):
    """A box.

    Attributes:
        size: Full edge lengths, in m.
    """

    size: tuple[float, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        size = checks.vector(f'Box "{self.name}": size', self.size, 3)
        for length in size:
            checks.positive(f'Box "{self.name}": size', length)
        object.__setattr__(self, "size", size)


@dataclass(frozen=True, kw_only=True)
class Sphere(WorldObject):
    """A sphere.

    Attributes:
        radius: In m.
    """

    lengths: ClassVar[tuple[str, ...]] = ("radius",)
    radius: float


@dataclass(frozen=True, kw_only=True)
class Capsule(WorldObject):
    """A cylinder along the object's z axis with a hemisphere at each end.

    Attributes:
        radius: In m.
        length: Length of the cylindrical part, in m.
    """

    lengths: ClassVar[tuple[str, ...]] = ("radius", "length")
    radius: float
    length: float


@dataclass(frozen=True, kw_only=True)
class Cylinder(WorldObject):
    """A cylinder along the object's z axis.

    Attributes:
        radius: In m.
        length: In m.
    """

    lengths: ClassVar[tuple[str, ...]] = ("radius", "length")
    radius: float
    length: float


@dataclass(frozen=True, kw_only=True)
class Mesh(WorldObject):
    """A triangle mesh from a file, with the moments of inertia of its bounding box.

    Attributes:
        path: Path of an stl, obj, dae, or msh file. Its origin is the object's center.
        scale: Scale factor for all lengths.

    Raises:
        ConfigError: If `path` is neither a string nor a `Path`, or an option is out of range.
    """

    lengths: ClassVar[tuple[str, ...]] = ("scale",)
    path: str | Path
    scale: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.path, (str, Path)):
            raise ConfigError(f'Mesh "{self.name}": path is {self.path!r} but must be a path.')
