"""Ground of a world, which never moves: a plane, stairs, or a height field.

A contact uses the smaller coefficient of friction, the larger coefficients of torsional and
rolling friction, and the product of the coefficients of restitution. By default, the restitution of
the body that touches the ground decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physx_core import checks
from physx_core.errors import ConfigError

MATERIAL = ("friction", "restitution", "torsional_friction", "rolling_friction")
"""Options of everything that can touch, none of which is negative."""


@dataclass(frozen=True)
class Ground:
    """An infinite plane whose upper side faces along `normal`.

    Attributes:
        friction: Coefficient of friction.
        restitution: Coefficient of restitution; 1: that of the other body decides.
        height: Height of the plane above the world's origin along the normal, in m.
        normal: Direction away from the ground, of any length.
        torsional_friction: Friction torque about the normal per normal force, in m.
        rolling_friction: Friction torque against rolling per normal force, in m.

    Raises:
        ConfigError: If an option is out of range, or the normal is 0.
    """

    friction: float = 1.0
    restitution: float = 1.0
    height: float = 0.0
    normal: tuple[float, ...] = (0.0, 0.0, 1.0)
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0

    def __post_init__(self) -> None:
        checks.store_declared("Ground.", self)
        checks.options(checks.not_negative, "Ground.", self, *MATERIAL)
        checks.finite("Ground.height", self.height)
        normal = checks.vector("Ground.normal", self.normal, 3)
        length = float(np.linalg.norm(normal))
        if not length > 0:
            raise ConfigError("Ground.normal must not be 0.")
        object.__setattr__(self, "normal", checks.scaled(normal, length))


@dataclass(frozen=True)
class Stairs:
    """A plane at height 0 with stairs that climb along x and a landing after the last step.

    Attributes:
        steps: Number of steps.
        rise: Height of each step, in m.
        run: Length of each step along x, in m.
        width: Width of the stairs along y, centered at y = 0, in m.
        begin: Position of the first step along x, in m.
        landing: Length of the last step beyond `run`, in m.
        friction: Coefficient of friction.
        restitution: Coefficient of restitution; 1: that of the other body decides.
        torsional_friction: Friction torque about the normal per normal force, in m.
        rolling_friction: Friction torque against rolling per normal force, in m.

    Raises:
        ConfigError: If an option is out of range.
    """

    steps: int = 5
    rise: float = 0.1
    run: float = 0.3
    width: float = 4.0
    begin: float = 1.0
    landing: float = 2.0
    friction: float = 1.0
    restitution: float = 1.0
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0

    def __post_init__(self) -> None:
        checks.store_declared("Stairs.", self)
        checks.options(checks.not_negative, "Stairs.", self, *MATERIAL)
        if self.steps < 1:
            raise ConfigError(f"Stairs.steps is {self.steps!r} but must be a positive integer.")
        checks.options(checks.positive, "Stairs.", self, "rise", "run", "width")
        checks.finite("Stairs.begin", self.begin)
        checks.not_negative("Stairs.landing", self.landing)

    def boxes(self) -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
        """Return the center and full size, in m, of the box under each step, from height 0 up."""
        found = []
        for step in range(self.steps):
            last = self.landing if step == self.steps - 1 else 0.0
            length, height = self.run + last, (step + 1) * self.rise
            x = self.begin + step * self.run + 0.5 * length
            found.append(((x, 0.0, 0.5 * height), (length, self.width, height)))
        return found


@dataclass(frozen=True, eq=False)
class HeightField:
    """Ground with heights given on a grid of points.

    Each grid cell consists of two triangles, split along the diagonal from its corner with the
    lowest x and y. There is no ground beyond the grid.

    Attributes:
        heights: In m, shape (nx, ny), at least 2 each; kept read-only.
        spacing: Distance between neighboring points along x and along y, in m.
        origin: x and y of the point ``heights[0, 0]``, in m; None: the grid is centered at 0, 0.
        friction: Coefficient of friction.
        restitution: Coefficient of restitution; 1: that of the other body decides.
        torsional_friction: Friction torque about the normal per normal force, in m.
        rolling_friction: Friction torque against rolling per normal force, in m.

    Raises:
        ConfigError: If the heights are not a grid of at least 2 x 2 finite numbers, or an option is
            out of range.
    """

    heights: NDArray[np.float64]
    spacing: tuple[float, ...] = (0.1, 0.1)
    origin: tuple[float, ...] | None = None
    friction: float = 1.0
    restitution: float = 1.0
    torsional_friction: float = 0.0
    rolling_friction: float = 0.0

    def __post_init__(self) -> None:
        checks.store_declared("HeightField.", self)
        checks.options(checks.not_negative, "HeightField.", self, *MATERIAL)
        heights = self.heights
        if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(heights).all():
            raise ConfigError(
                f"HeightField.heights has the shape {heights.shape} but needs two axes of 2 or "
                "more finite numbers."
            )
        spacing = checks.vector("HeightField.spacing", self.spacing, 2)
        for distance in spacing:
            checks.positive("HeightField.spacing", distance)
        origin = self.origin
        if origin is None:
            extent = (np.array(heights.shape) - 1) * spacing
            origin = tuple(-0.5 * extent)
        object.__setattr__(self, "spacing", spacing)
        object.__setattr__(self, "origin", checks.vector("HeightField.origin", origin, 2))

    def corner(self) -> tuple[float, float]:
        """Return x and y of the point ``heights[0, 0]``, in m."""
        x, y = self.origin or (0.0, 0.0)
        return x, y
