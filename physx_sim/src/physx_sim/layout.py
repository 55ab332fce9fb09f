"""Layout of a simulation's state, and the records that simulations return.

Every engine follows Pinocchio's convention: first the robots in the world's order, then the moving
objects. In each robot, a floating base comes first (position x, y, z in m and quaternion x, y, z,
w; velocity as the base's twist in its own frame: linear in m/s, then angular in rad/s), then the
joints in the order of the model file's tree. Every joint with one degree of freedom is one number,
even a continuous one. An object is like a floating base without joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from physx_core.typing import Records, Vector
from physx_sim.description.attachment import Attachment
from physx_sim.description.body_settings import BodySettings
from physx_sim.description.ground import HeightField
from physx_sim.description.wrench import Wrench

CONTACT = np.dtype(
    [
        ("body_a", np.int32),
        ("body_b", np.int32),
        ("point", np.float64, (3,)),
        ("force", np.float64, (3,)),
        ("normal", np.float64, (3,)),
        ("depth", np.float64),
        ("torque", np.float64, (3,)),
    ]
)
"""A contact: the bodies (indices into `Layout.names`, `body_a` before `body_b`, so a static one is
`body_b`); the point, in m; the force on `body_a`, in N (that on `body_b` is opposite); the unit
normal from `body_b` to `body_a`; the penetration depth, in m; the torque on `body_a` about the
point, in N m, of torsional and rolling friction. All in the world frame."""

RAY_HIT = np.dtype(
    [
        ("hit", np.bool_),
        ("body", np.int32),
        ("point", np.float64, (3,)),
        ("normal", np.float64, (3,)),
        ("fraction", np.float64),
    ]
)
"""The first hit of a ray: whether there is one; the body (index into `Layout.names`, -1: none); the
point in m and the surface normal, in the world frame; the fraction along the ray, in [0, 1]."""


@dataclass(frozen=True)
class Part:
    """Slices of the state that belong to one robot or moving object.

    Attributes:
        name: Name of the robot or object.
        floating: Whether it has a floating base.
        positions: Its slice of the positions.
        velocities: Its slice of the velocities.
        joints: Its slice of the joints, and thus of the commands.
        bodies: Its slice of the bodies.
    """

    name: str
    floating: bool
    positions: slice
    velocities: slice
    joints: slice
    bodies: slice

    @property
    def nq(self) -> int:
        """Length of its positions."""
        return int(self.positions.stop - self.positions.start)

    @property
    def nv(self) -> int:
        """Length of its velocities."""
        return int(self.velocities.stop - self.velocities.start)


@dataclass(frozen=True)
class Layout:
    """Names and indices of everything in a state; fixed when the simulation is built.

    Attributes:
        joints: Names of the joints with one degree of freedom, in the state's order. With several
            robots, each name is prefixed with the robot's name and ``/``.
        bodies: Names of the links, prefixed likewise, and of the moving objects.
        position_index: Index of each joint in the positions, by joint name.
        velocity_index: Index of each joint in velocities and torques, by joint name.
        nq: Length of the positions: 7 for each floating base and object, 1 for each joint.
        nv: Length of velocities and torques: 6 for each floating base and object, 1 for each joint.
        lower: Lower limits of the joints' positions, shape (joints,), in rad or m; -inf: none.
        upper: Upper limits of the joints' positions, in the same form; inf: none.
        max_velocity: Limits of the joints' velocities, shape (joints,), in rad/s or m/s.
        max_torque: Limits of the joints' torques, shape (joints,), in N m or N.
        parts: Slices of each robot and moving object, by name.
        statics: Names of all static bodies: ``"ground"``, then the static objects.
        modes: Command mode of each joint, as in `JointSettings`.
        units: Unit of each joint's position: rad, or m for a prismatic one.
    """

    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    position_index: dict[str, int]
    velocity_index: dict[str, int]
    nq: int
    nv: int
    lower: Vector
    upper: Vector
    max_velocity: Vector
    max_torque: Vector
    parts: Mapping[str, Part] = field(default_factory=dict)
    statics: tuple[str, ...] = ()
    modes: tuple[str, ...] = ()
    units: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of everything that can be touched: the bodies, then the static bodies."""
        return (*self.bodies, *self.statics)


@dataclass(frozen=True)
class AppliedWrench:
    """A wrench that acts on a world.

    Attributes:
        number: Its number for `Simulation.remove_wrench`.
        begin: Frame in which it was applied.
        wrench: The wrench.
    """

    number: int
    begin: int
    wrench: Wrench


@dataclass(frozen=True)
class AppliedAttachment:
    """An attachment that holds bodies of a world together.

    Attributes:
        number: Its number for `Simulation.detach`.
        attachment: The attachment; what was left to the moment of attaching is filled in.
    """

    number: int
    attachment: Attachment


@dataclass(frozen=True)
class State:
    """A snapshot of a simulation; plain and picklable.

    Attributes:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        commands: The held commands, shape (joints,).
        frame: Number of physics steps since the simulation was built.
        wrenches: Active wrenches.
        engine: Name of the engine that it was taken from.
        native: The engine's own representation of its state.
        attachments: Active attachments.
        accelerations: Accelerations of the last step, shape (nv,); empty: none.
        contacts: Contacts of the last step, `CONTACT` records.
        gravity: Acceleration of free fall, in m/s², shape (3,); empty: that of the world.
        bodies: What was changed about bodies since the simulation was built, by name.
        ground: The height field that replaced the ground since then, if any.
    """

    positions: Vector
    velocities: Vector
    commands: Vector
    frame: int
    wrenches: tuple[AppliedWrench, ...] = ()
    engine: str = ""
    native: tuple[Vector, ...] = ()
    attachments: tuple[AppliedAttachment, ...] = ()
    accelerations: Vector = field(default_factory=lambda: np.zeros(0))
    contacts: Records = field(default_factory=lambda: np.zeros(0, CONTACT))
    gravity: Vector = field(default_factory=lambda: np.zeros(0))
    bodies: Mapping[str, BodySettings] = field(default_factory=dict)
    ground: HeightField | None = None
