"""Robot models: what engines load, and the options of a robot that apply to any file."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physx_core.errors import listed, nearest
from physx_sim import Robot
from physx_sim.engines.models.rigid_bodies import Inertial, Joint, RigidBody
from physx_sim.engines.models.shapes import CollisionShape
from physx_sim.errors import ModelError


@dataclass(frozen=True)
class RobotModel:
    """The model of a robot.

    Attributes:
        path: Absolute path of the file.
        bodies: The links, parents before children, in tree order.
        shapes: Collision shapes; empty if there is nothing to touch.
        warnings: What is wrong with the file, although it can be simulated, and what of it no
            engine is told.
    """

    path: Path
    bodies: tuple[RigidBody, ...]
    shapes: tuple[CollisionShape, ...] = ()
    warnings: tuple[str, ...] = ()

    @functools.cached_property
    def links(self) -> tuple[str, ...]:
        """Names of all links, in the order of `bodies`."""
        return tuple(body.name for body in self.bodies)

    @functools.cached_property
    def joints(self) -> tuple[Joint, ...]:
        """The joints with one degree of freedom, in the order of `bodies`."""
        return tuple(body.joint for body in self.bodies if body.joint is not None)


def model_of_body(name: str, path: Path, inertial: Inertial, shape: CollisionShape) -> RobotModel:
    """Return the model of an object: a robot with one link.

    Args:
        name: Name of the link.
        path: Name of the object, as a path.
        inertial: The link's inertia.
        shape: Its collision shape.
    """
    body = RigidBody(name, -1, np.eye(4), None, np.zeros(3), *inertial.in_link())
    return RobotModel(path, (body,), (shape,))


def check_names(robot: Robot, links: Sequence[str], joints: Sequence[str]) -> None:
    """Check that a robot's options name links and joints of its file.

    Args:
        robot: The robot's description.
        links: Names of all links.
        joints: Names of the movable joints.
    """
    for option, given, kind, known in (
        ("joints", robot.joints, "movable joint", joints),
        ("mass_factors", robot.mass_factors, "link", links),
        ("feet", robot.feet, "link", links),
    ):
        for name in given:
            if name not in known:
                raise ModelError(
                    f'{option} names "{name}", which is not a {kind}.{nearest(name, known)} '
                    f"{kind.rpartition(' ')[2].capitalize()}s: {listed(known)}"
                )
