"""RobotBackend: an engine whose worlds may name robots of physx instead of files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from physx_core.engines.models import catalog, robot_files
from physx_core.simulation import Backend, RobotInfo


class RobotBackend(Backend):
    """A physics engine that loads its robots with `physx_core.engines.read_parts`."""

    def robots(self) -> Sequence[RobotInfo]:
        """Return the robots of physx and of ``example-robot-data``."""
        return catalog.robots()

    def robot_path(self, name: str) -> Path | None:
        """Return the URDF file of the robot of a name, None if there is none."""
        return robot_files.robot_path(name)
