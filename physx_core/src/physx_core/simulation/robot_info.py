"""Description of a robot that a backend knows by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RobotInfo:
    """A robot that a world may name instead of a file, as in ``Robot("cartpole")``.

    Attributes:
        name: Name of the robot.
        path: Its model file.
        joints: Number of its joints' degrees of freedom; a floating base has 6 more.
        mass: Of all its links, in kg.
        collisions: Kind of its collision shapes: ``"primitives"``, ``"meshes"``, ``"both"`` or
            ``"none"``.
        warning: Caveat about using it; empty: none.
        error: Reason why it cannot be loaded, empty if it can. The other values are then 0 and
            ``"none"``.
    """

    name: str
    path: Path
    joints: int = 0
    mass: float = 0.0
    collisions: str = "none"
    warning: str = ""
    error: str = ""
