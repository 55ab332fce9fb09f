"""World descriptions: plain, picklable data from which any backend builds its simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from physx_core.errors import ConfigError


@dataclass(frozen=True)
class Robot:
    """A robot from a URDF file.

    Attributes:
        urdf: Path of the URDF file.
        name: Name of the robot in the world.
        fixed_base: Whether the root link is welded to the world; otherwise it floats freely.
        package_dirs: Folder of each package that mesh names ``package://<name>/...`` begin with.
    """

    urdf: str | Path
    name: str = "robot"
    fixed_base: bool = True
    package_dirs: Mapping[str, str | Path] = field(default_factory=dict)


@dataclass(frozen=True)
class World:
    """Everything that a simulation is built from.

    Attributes:
        robots: The robots; their names differ.
        period: Length of one physics step, in s.
        gravity: Acceleration of free fall in the world frame, in m/s².
    """

    robots: Sequence[Robot]
    period: float = 1e-3
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)

    def __post_init__(self) -> None:
        """Check that the description makes sense.

        Raises:
            ConfigError: No robot, two of one name, or a period that is not positive.
        """
        names = [robot.name for robot in self.robots]
        if not names or len(set(names)) != len(names):
            raise ConfigError(f"A world needs robots with names that differ, not {names}.")
        if not self.period > 0:
            raise ConfigError(f"World.period is {self.period} but must be positive.")
