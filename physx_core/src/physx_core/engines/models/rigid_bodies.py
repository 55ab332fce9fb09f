"""Rigid bodies: the links of a robot as numbers, for engines that do not read URDF."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from physx_core.engines.models.urdf import Joint, RobotModel
from physx_core.simulation import UrdfTree, link_of, numbers_of, origin_of
from physx_core.typing import Vector

_INERTIAL = ("inertial", "inertial/mass", "inertial/inertia")
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


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


def rigid_bodies(model: RobotModel) -> tuple[RigidBody, ...]:
    """Return the links of a robot or object as rigid bodies, parents before children."""
    tree = UrdfTree(ElementTree.fromstring(model.text))
    joints = {joint.name: joint for joint in model.joints}
    places = {name: place for place, name in enumerate(tree.links)}
    found = []
    for name in tree.links:
        above = tree.parents.get(name)
        parent, pose, joint, axis = -1, np.eye(4), None, np.zeros(3)
        if above is not None:
            where = f'joint "{above.get("name")}"'
            parent, pose = places[link_of(above, "parent")], origin_of(where, above)
            joint, given = joints.get(above.get("name", "")), above.find("axis")
            if joint is not None and given is not None:
                axis = np.array(numbers_of(where, given, "xyz", "", 3))
        inertial = _inertial(f'link "{name}"', tree.elements[name])
        found.append(RigidBody(name, parent, pose, joint, axis, *inertial))
    return tuple(found)


def _inertial(where: str, link: Element) -> tuple[float, Vector, Vector]:
    """Return the mass, center of mass, and moments of inertia of a link in the engines' text."""
    (inertial,), (mass,), (given,) = (link.findall(path) for path in _INERTIAL)
    (number,) = numbers_of(where, mass, "value", "", 1)
    xx, yy, zz, xy, xz, yz = (numbers_of(where, given, name, "", 1)[0] for name in _MOMENTS)
    place = origin_of(where, inertial)
    turn = place[:3, :3]
    inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    return number, place[:3, 3], inertia
