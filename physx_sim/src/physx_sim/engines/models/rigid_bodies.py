"""Rigid bodies: the links and joints of a robot as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from physx_core.rotations import from_roll_pitch_yaw, to_matrix
from physx_core.typing import Vector
from physx_sim.description.robot import Mimic, Mode


@dataclass(frozen=True)
class Joint:
    """A joint with one degree of freedom.

    Attributes:
        name: Name in the file.
        lower: Lower position limit, in rad or m; -inf: none.
        upper: Upper position limit, in rad or m; inf: none.
        max_velocity: Limit of the velocity, in rad/s or m/s.
        max_torque: Limit of the torque, in N m or N.
        mode: Meaning of its commands, as in `JointSettings`.
        gain: Of a servo that tracks positions, as in `JointSettings`.
        unit: Unit of its position, rad or m.
        damping: Viscous damping, in N m s/rad or N s/m.
        friction: Coulomb friction, in N m or N.
        stiffness: Stiffness of a spring between the links, in N m/rad or N/m.
        rest: Rest position of the spring, in rad or m.
        armature: Inertia of the motor's rotor as seen from the joint, in kg m² or kg.
        mimic: How it follows another joint, which follows none; it then has no torque.
    """

    name: str
    lower: float
    upper: float
    max_velocity: float
    max_torque: float
    mode: Mode
    gain: float
    unit: str
    damping: float
    friction: float
    stiffness: float
    rest: float
    armature: float
    mimic: Mimic | None = None


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A link and its connection to its parent.

    Attributes:
        name: Name of the link.
        parent: Index of its parent among the links; -1: it is the root.
        pose: Its frame relative to its parent's with the joint at 0, a homogeneous matrix of shape
            (4, 4), in m.
        joint: The joint about or along whose axis it moves; None: it is fixed to its parent, or is
            the root.
        axis: Unit axis of the joint in its own frame, shape (3,); zeros without a joint.
        mass: In kg.
        center: Center of mass in its own frame, shape (3,), in m.
        inertia: Moments of inertia about the center of mass in its own frame, shape (3, 3), in
            kg m². A file may contain values that are physically impossible.
    """

    name: str
    parent: int
    pose: Vector
    joint: Joint | None
    axis: Vector
    mass: float
    center: Vector
    inertia: Vector


class Origin(NamedTuple):
    """A pose as in a URDF file: translation in m; roll, pitch and yaw in rad."""

    xyz: Sequence[float] = (0.0, 0.0, 0.0)
    rpy: Sequence[float] = (0.0, 0.0, 0.0)

    def matrix(self) -> Vector:
        """Return it as a homogeneous matrix, shape (4, 4)."""
        pose = np.eye(4)
        pose[:3, 3] = self.xyz
        if any(self.rpy):
            pose[:3, :3] = to_matrix(from_roll_pitch_yaw(*self.rpy))
        return pose


class Inertial(NamedTuple):
    """The inertia of a link as in a URDF file.

    Attributes:
        mass: In kg.
        moments: Moments of inertia xx, yy, zz, xy, xz, yz about the axes of `origin`, in kg m².
        origin: The center of mass, and the axes of the moments.
    """

    mass: float
    moments: Sequence[float]
    origin: Origin = Origin()

    def in_link(self) -> tuple[float, Vector, Vector]:
        """Return mass, center of mass (3,) and moments (3, 3) about it in the link's frame."""
        xx, yy, zz, xy, xz, yz = self.moments
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if any(self.origin.rpy):
            turn = self.origin.matrix()[:3, :3]
            inertia = turn @ inertia @ turn.T
        return self.mass, np.array(self.origin.xyz, np.float64), inertia


class Together(NamedTuple):
    """Links as one body.

    Attributes:
        mass: In kg.
        center: Center of mass in the frame of the first link, shape (3,), in m.
        inertia: Moments of inertia about it there, shape (3, 3), in kg m².
        scale: Inertia to which its rounding errors are relative, in kg m².
    """

    mass: float
    center: Vector
    inertia: Vector
    scale: float = 0.0


def together(bodies: Sequence[RigidBody], links: Sequence[int]) -> Together:
    """Return links, parents before children, that cannot move relative to each other as one."""
    first = bodies[links[0]]
    if len(links) == 1:
        return Together(first.mass, first.center, first.inertia)
    poses = {links[0]: np.eye(4)}
    for link in links[1:]:
        poses[link] = poses[bodies[link].parent] @ bodies[link].pose
    rows = list(poses)
    turns, places = (np.array([pose[:3, x] for pose in poses.values()]) for x in (slice(3), 3))
    masses = np.array([bodies[link].mass for link in rows])
    centers = np.array([bodies[link].center for link in rows])
    centers = np.einsum("nij,nj->ni", turns, centers) + places
    mass = float(masses.sum())
    center = masses @ centers / mass
    arms = centers - center
    squares = masses * np.square(arms).sum(axis=1)
    inertia = squares.sum() * np.eye(3) - (masses * arms.T) @ arms
    own = np.array([bodies[link].inertia for link in rows])
    inertia += (turns @ own @ turns.transpose(0, 2, 1)).sum(axis=0)
    scale = float(masses @ np.square(centers).sum(axis=1))
    return Together(mass, center, inertia, scale)
