"""Rows of wheels that roll on the ground without slip."""

from __future__ import annotations

import numpy as np

from physx_core.rotations import cross_rows
from physx_core.typing import Vector
from physx_dart.pinocchio.robot import PinocchioRobot
from physx_sim import Ground

_NEAR = 0.01
"""Height above the ground, as a fraction of its radius, up to which a wheel is on the ground."""
_FLAT = 1e-6
"""Sine of the angle between axis and normal below which a wheel lies on its side."""


class Wheels:
    """The wheels of a robot.

    Where such a wheel touches the ground, its material does not move. As these constraints do not
    follow from any of positions, nothing is corrected in later steps.

    Args:
        robot: The robot.
        ground: The plane on which they roll.

    Attributes:
        surface: Velocity of the ground's surface, in m/s, shape (3,).
    """

    def __init__(self, robot: PinocchioRobot, ground: Ground) -> None:
        links = robot.model.links
        self._robot, self._normal, self._height = robot, np.array(ground.normal), ground.height
        self._wheels = [
            (robot.frames[links.index(wheel.link)], np.array(wheel.axis), wheel)
            for wheel in robot.model.wheels
        ]
        self.surface = np.zeros(3)

    def rows(self, motions: Vector, supports: Vector) -> tuple[Vector, Vector]:
        """Return the Jacobian of all rows, shape (m, nv), and the velocities along them (m,).

        Args:
            motions: Twists for unit velocities, after `PinocchioRobot.place_joints`, (6, nv).
            supports: Which velocities move each joint, as from `supports_of`.
        """
        robot, normal = self._robot, self._normal
        rows, speeds = [np.zeros((0, motions.shape[1]))], [np.zeros(0)]
        for frame, axis, wheel in self._wheels:
            link = robot.model_in_motion.frames[frame]
            pose = robot.data.oMi[link.parentJoint] * link.placement
            axle = pose.rotation @ axis
            upright = normal - normal.dot(axle) * axle
            length = float(np.linalg.norm(upright))
            if length < _FLAT:
                continue
            point = pose.translation - wheel.radius / length * upright
            if point.dot(normal) - self._height > _NEAR * wheel.radius:
                continue
            forward = cross_rows(axle, normal) / length
            directions = np.array([forward, cross_rows(normal, forward)])[: 1 + wheel.lateral]
            moved = motions * supports[link.parentJoint]
            moved[:3] += cross_rows(moved[3:].T, point[None]).T
            rows.append(directions @ moved[:3])
            speeds.append(directions @ self.surface)
        return np.concatenate(rows), np.concatenate(speeds)
