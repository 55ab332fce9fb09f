"""Reading of a robot's file, whatever its format."""

from __future__ import annotations

import dataclasses

from physx_sim import Robot
from physx_sim.engines.models.inertias import inertia_warnings
from physx_sim.engines.models.mjcf import read_mjcf
from physx_sim.engines.models.mjcf_file import is_mjcf
from physx_sim.engines.models.robot_files import find_robot
from physx_sim.engines.models.robot_model import RobotModel, with_wheels
from physx_sim.engines.models.urdf import read_urdf
from physx_sim.errors import ModelError


def read_robot(robot: Robot, *, touching: bool = False) -> RobotModel:
    """Read a robot's file: URDF, or MJCF if its root element is ``mujoco``.

    Args:
        robot: The robot's description.
        touching: Whether to read its collision shapes.

    Raises:
        ModelError: If the file or a mesh is missing, the file is invalid or has joints that are not
            supported, or the robot's options do not fit it.
    """
    path = find_robot(robot.urdf)
    try:
        if is_mjcf(path):
            model = read_mjcf(robot, path, touching=touching)
        else:
            model = read_urdf(robot, path, touching=touching)
        if robot.wheels:
            model = with_wheels(robot, model)
        doubts = inertia_warnings(model.bodies, robot.fixed_base)
    except (ModelError, ValueError) as error:
        if str(path) in str(error):
            raise
        raise ModelError(f'Robot "{robot.name}", {path}: {error}.') from error
    return dataclasses.replace(model, warnings=doubts + model.warnings)
