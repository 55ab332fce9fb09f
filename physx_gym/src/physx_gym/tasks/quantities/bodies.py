"""Quantities of the poses and velocities of bodies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from physx_core import rotations
from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_gym.tasks.quantities import geometry
from physx_gym.tasks.quantities.combined import Rate
from physx_gym.tasks.quantities.quantity import Moment, Quantity

Form = Literal["quaternion", "roll_pitch_yaw", "matrix"]


@dataclass(frozen=True)
class BodiesQuantity(Quantity):
    """A quantity of some bodies.

    Attributes:
        bodies: Names in the layout.
    """

    bodies: tuple[str, ...]


@dataclass(frozen=True)
class BodyPoses(BodiesQuantity):
    """Poses of bodies in the world, shape (bodies, 7): position in m, quaternion x, y, z, w."""

    def compute(self, moment: Moment) -> Vector:
        """Return the poses."""
        return moment.body_poses(self.bodies)


@dataclass(frozen=True)
class BodyPositions(BodiesQuantity):
    """Positions of bodies in the world, shape (bodies, 3), in m."""

    def compute(self, moment: Moment) -> Vector:
        """Return the positions."""
        return np.asarray(moment.get(BodyPoses(self.bodies))[:, :3])


@dataclass(frozen=True)
class BodyOrientations(BodiesQuantity):
    """Orientations of bodies in the world.

    Attributes:
        form: ``"quaternion"``, shape (bodies, 4); ``"roll_pitch_yaw"``, (bodies, 3), in rad; or
            ``"matrix"``, (bodies, 3, 3).
    """

    form: Form = "quaternion"

    def compute(self, moment: Moment) -> Vector:
        """Return the orientations."""
        quaternions = moment.get(BodyPoses(self.bodies))[:, 3:]
        if self.form == "quaternion":
            return np.asarray(quaternions)
        if self.form == "matrix":
            return rotations.to_matrix_rows(quaternions)
        return rotations.to_roll_pitch_yaw_rows(quaternions)


@dataclass(frozen=True)
class BodyVelocities(BodiesQuantity):
    """Velocities of bodies' origins, shape (bodies, 6): linear in m/s, then angular in rad/s.

    Attributes:
        frame: ``"world"``: along the world's axes; ``"body"``: along each body's own.
    """

    frame: Literal["world", "body"] = "world"

    def compute(self, moment: Moment) -> Vector:
        """Return the velocities."""
        velocities = moment.body_velocities(self.bodies)
        if self.frame == "world":
            return velocities
        turn = moment.get(BodyPoses(self.bodies))[:, 3:]
        parts = [rotations.rotate_back_rows(turn, v) for v in np.hsplit(velocities, 2)]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class MeanBodyVelocities(BodiesQuantity):
    """Velocities of bodies over the last step, shape (bodies, 6), along the world's axes."""

    def compute(self, moment: Moment) -> Vector:
        """Return displacement and rotation over the step, divided by its duration."""
        return np.asarray(moment.get(Rate(BodyPoses(self.bodies), geometry.pose_difference)))


@dataclass(frozen=True)
class MeanPose(BodiesQuantity):
    """The mean of several bodies' poses, shape (7,), for example of all feet."""

    def compute(self, moment: Moment) -> Vector:
        """Return mean position and mean orientation."""
        poses = moment.get(BodyPoses(self.bodies))
        return np.concatenate([poses[:, :3].mean(0), rotations.mean(poses[:, 3:])])


@dataclass(frozen=True)
class RelativePoses(BodiesQuantity):
    """Poses of at least two bodies relative to their mean pose, shape (bodies, 7).

    Raises:
        ConfigError: If there are fewer than two bodies.
    """

    def __post_init__(self) -> None:
        """Check the number of bodies."""
        super().__post_init__()
        if len(self.bodies) < 2:
            raise ConfigError(f"RelativePoses needs at least two bodies, not {self.bodies}.")

    def compute(self, moment: Moment) -> Vector:
        """Return the poses."""
        poses = moment.get(BodyPoses(self.bodies))
        return geometry.relative_poses(poses, moment.get(MeanPose(self.bodies)))


@dataclass(frozen=True)
class MeanOdometry(BodiesQuantity):
    """Mean position on the ground and heading of bodies: x and y in m, yaw in rad, shape (3,)."""

    def compute(self, moment: Moment) -> Vector:
        """Return the planar pose."""
        return _planar(moment.get(MeanPose(self.bodies)))


def _planar(pose: Vector) -> Vector:
    """Return x, y and yaw of a pose."""
    return np.array([pose[0], pose[1], rotations.to_roll_pitch_yaw(pose[3:].tolist())[2]])


def _root(moment: Moment) -> tuple[str]:
    """Return the root link of the controlled robot."""
    return (moment.simulator.layout.bodies[moment.robot.bodies][0],)


@dataclass(frozen=True)
class RollPitch(Quantity):
    """Roll and pitch of the robot's root link in rad, shape (2,)."""

    def compute(self, moment: Moment) -> Vector:
        """Return the angles."""
        return np.asarray(moment.get(BodyOrientations(_root(moment), "roll_pitch_yaw"))[0, :2])


@dataclass(frozen=True)
class BaseHeight(Quantity):
    """Height of the robot's root link, in m: above z = 0, or above the lowest of some bodies.

    Attributes:
        over: Names in the layout, for example the feet; none: z = 0.
    """

    over: tuple[str, ...] = ()

    def compute(self, moment: Moment) -> float:
        """Return the height."""
        height = float(moment.get(BodyPoses(_root(moment)))[0, 2])
        if self.over:
            height -= float(moment.get(BodyPositions(self.over))[:, 2].min())
        return height


@dataclass(frozen=True)
class Odometry(Quantity):
    """Position on the ground and heading of the root link: x and y in m, yaw in rad, shape (3,)."""

    def compute(self, moment: Moment) -> Vector:
        """Return the planar pose."""
        return _planar(moment.get(BodyPoses(_root(moment)))[0])


@dataclass(frozen=True)
class BaseVelocity(Quantity):
    """Velocity of the root link in its own frame: linear in m/s, angular in rad/s, shape (6,)."""

    def compute(self, moment: Moment) -> Vector:
        """Return the velocity."""
        return np.asarray(moment.get(BodyVelocities(_root(moment), "body"))[0])


@dataclass(frozen=True)
class OdometryVelocity(Quantity):
    """Velocity over the last step: forward and to the left in m/s, yaw rate in rad/s, shape (3,).

    Resolved along the heading halfway between the start and end of the step.
    """

    def compute(self, moment: Moment) -> Vector:
        """Return the velocity."""
        return np.asarray(moment.get(Rate(Odometry(), geometry.odometry_difference)))
