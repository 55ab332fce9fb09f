"""Catalog of the robots that a world may refer to by name, described without loading meshes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

from physx_core.errors import PhysxError
from physx_sim import Robot, RobotInfo, parse_urdf
from physx_sim.engines.models.reading import read_robot
from physx_sim.engines.models.robot_files import mesh_path, named_robots

_NO_DIRS: Mapping[str, str | Path] = {}


def robots() -> tuple[RobotInfo, ...]:
    """Return the robots of physx, then those of ``example-robot-data`` if installed."""
    return tuple(describe(name, path) for name, path in named_robots().items())


def describe(name: str, path: Path) -> RobotInfo:
    """Return the description of a robot.

    Args:
        name: Name of the robot.
        path: Its URDF file; if it cannot be loaded, the result gives the reason.
    """
    try:
        model = read_robot(Robot(path))
        root = parse_urdf(path)
    except PhysxError as error:
        return RobotInfo(name, path, error=str(error))
    shapes = [shape for each in root.iter("collision") for shape in each.iterfind("geometry/*")]
    meshes = [shape for shape in shapes if shape.tag == "mesh"]
    return RobotInfo(
        name,
        path,
        len(model.joints),
        sum(body.mass for body in model.bodies),
        _kind(len(shapes) - len(meshes), len(meshes)),
        _mesh_warnings(path, meshes) + model.warnings,
    )


def _kind(primitives: int, meshes: int) -> str:
    if primitives and meshes:
        return "both"
    return "primitives" if primitives else "meshes" if meshes else "none"


def _mesh_warnings(path: Path, meshes: list[Element]) -> tuple[str, ...]:
    """Return a warning about collision meshes, if any; their files are located but not read."""
    if not meshes:
        return ()
    files = {mesh_path(path, mesh.get("filename", ""), _NO_DIRS) for mesh in meshes}
    size = sum(file.stat().st_size for file in files if file is not None) / 1e6
    plural = "es" if len(meshes) > 1 else ""
    return (f"slow: {len(meshes)} collision mesh{plural} ({size:.2g} MB)",)
