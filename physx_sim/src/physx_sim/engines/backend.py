"""RobotBackend: an engine whose worlds may refer to physx's robots by name instead of by file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from physx_sim import Backend, RobotInfo
from physx_sim.engines.models import catalog, robot_files


class RobotBackend(Backend):
    """A physics engine that loads its robots with `physx_sim.engines.read_parts`."""

    def robots(self) -> Sequence[RobotInfo]:
        """Return the robots of physx and ``example-robot-data``."""
        return catalog.robots()

    def robot_path(self, name: str) -> Path | None:
        """Return the URDF file of a named robot, or None if there is none."""
        return robot_files.robot_path(name)
