"""Wheels that roll without slip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physx_core import checks
from physx_core.errors import ConfigError


@dataclass(frozen=True)
class Wheel:
    """A link that rolls without slip on the ground, a plane, however hard it is pulled.

    While its lowest point is on the ground, it stands still there: along the direction in which the
    wheel rolls, and across it. This takes the place of the friction of the link, whose shapes only
    carry it. Feature `rolling`.

    Attributes:
        link: Name of the link in the file, whose origin is the center of the wheel.
        radius: Distance from the center to the ground, in m.
        axis: Axis of the wheel in the link's frame, of any length.
        lateral: Whether it does not slide along its axis, either; False for omni-wheels.

    Raises:
        ConfigError: If an option has the wrong type or is out of range, or the axis is 0.
    """

    link: str
    radius: float
    axis: tuple[float, ...] = (0.0, 1.0, 0.0)
    lateral: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.link, str):
            raise ConfigError(f"Wheel.link is {self.link!r}, not the name of a link.")
        where = f'Wheel "{self.link}": '
        checks.store_declared(where, self)
        checks.positive(f"{where}radius", self.radius)
        axis = checks.vector(f"{where}axis", self.axis, 3)
        length = float(np.linalg.norm(axis))
        if not length > 0:
            raise ConfigError(f"{where}axis must not be 0.")
        object.__setattr__(self, "axis", checks.scaled(axis, length))
