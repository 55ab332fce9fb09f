"""Robot models from URDF files: names, joints, collision shapes, and URDF text for the engines.

All engines load the same text, written from the numbers read here, since readers disagree about
what counts as a number: links with their inertia, joints with their origin and axis. Everything
else is read here, so it means the same in every engine:

- Shapes are omitted; `physx_sim.engines.models.shapes` reads those for collisions. All meshes must
  exist.
- A link without mass gets 1e-9 kg and, unless it has moments of inertia, 1e-12 kg m².
- Mimic joints are treated as ordinary joints.
- A position limit whose ends are equal or absent, or a velocity or effort limit that is 0 or
  absent, counts as no limit: many files contain zeros for unknown limits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from physx_core.errors import listed, nearest
from physx_sim import (
    JointSettings,
    Robot,
    UrdfTree,
    link_of,
    numbers_of,
    parse_urdf,
)
from physx_sim.engines.models.inertias import MASSLESS, NEGLIGIBLE, inertia_warnings
from physx_sim.engines.models.rigid_bodies import Inertial, Joint, Origin, RigidBody
from physx_sim.engines.models.robot_files import check_meshes, find_robot
from physx_sim.engines.models.shapes import CollisionShape, shapes_of_robot
from physx_sim.errors import ModelError

_MOVING = ("revolute", "continuous", "prismatic")
_UNLIMITED = '<limit lower="-1e9" upper="1e9" effort="1e9" velocity="1e9"/>'
_PLAIN = JointSettings()
_SPECIAL = re.compile('[&<>"\t\n\r]')
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_NO_INERTIA = Inertial(MASSLESS, (NEGLIGIBLE, NEGLIGIBLE, NEGLIGIBLE, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class RobotModel:
    """The model of a robot.

    Attributes:
        path: Absolute path of the file.
        text: URDF text for the engines.
        links: Names of all links, parents before children, in tree order.
        joints: The joints with one degree of freedom, in tree order.
        bodies: The links as numbers, those of `text`, in the order of `links`.
        shapes: Collision shapes; empty if there is nothing to touch.
        warnings: What is wrong with the file, although it can be simulated.
    """

    path: Path
    text: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    bodies: tuple[RigidBody, ...]
    shapes: tuple[CollisionShape, ...] = ()
    warnings: tuple[str, ...] = ()


class _Link(NamedTuple):
    """A link and the joint that leads to it, which only the root link lacks."""

    name: str
    parent: str = ""
    joint_name: str = ""
    origin: Origin = Origin()
    joint: Joint | None = None
    axis: Sequence[float] = (0.0, 0.0, 0.0)


def read_robot(robot: Robot, *, touching: bool = False) -> RobotModel:
    """Read a robot's URDF file.

    The tree is walked depth first, with the children of a link sorted by joint name.

    Args:
        robot: The robot's description.
        touching: Whether to read its collision shapes.

    Raises:
        ModelError: If the file or a mesh is missing, the file is invalid or has joints that are not
            supported, or the robot's options do not fit it.
    """
    path = find_robot(robot.urdf)
    root = parse_urdf(path)
    check_meshes(path, root, robot.package_dirs)
    try:
        tree = UrdfTree(root)
        if not robot.fixed_base and tree.links[0] == "world":
            raise ModelError("its root link is the world, which cannot float; use fixed_base=True")
        for joint in tree.joints:
            if joint.get("type", "") not in (*_MOVING, "fixed"):
                name, kind = joint.get("name"), joint.get("type", "")
                raise ModelError(f'joint "{name}" has the type "{kind}", which is not supported')
        moving = [joint for joint in tree.joints if joint.get("type") in _MOVING]
        joints = tuple(_joint(joint, robot.joints) for joint in moving)
        _check_settings(robot, joints)
        _check_masses(robot, list(tree.links))
        inertials = [
            _inertial(name, tree.elements[name], float(robot.mass_factors.get(name, 1.0)))
            for name in tree.links
        ]
        links = _links(tree, joints)
        bodies = _bodies(links, inertials)
        doubts = inertia_warnings(bodies, robot.fixed_base)
        shapes = shapes_of_robot(robot, path, tree) if touching else ()
    except (ModelError, ValueError) as error:
        raise ModelError(f'Robot "{robot.name}", {path}: {error}.') from error
    text = _engine_text(links, inertials)
    return RobotModel(path, text, tuple(tree.links), joints, bodies, shapes, doubts)


def model_of_body(name: str, path: Path, inertial: Inertial, shape: CollisionShape) -> RobotModel:
    """Return the model of an object: a robot with one link.

    Args:
        name: Name of the link.
        path: Name of the object, as a path.
        inertial: The link's inertia.
        shape: Its collision shape.
    """
    links = [_Link(name)]
    text, bodies = _engine_text(links, [inertial]), _bodies(links, [inertial])
    return RobotModel(path, text, (name,), (), bodies, (shape,))


def _check_settings(robot: Robot, joints: tuple[Joint, ...]) -> None:
    known = [joint.name for joint in joints]
    for name in robot.joints:
        if name not in known:
            raise ModelError(
                f'joints has settings for "{name}", which is not a movable joint.'
                f"{nearest(name, known)} Joints: {listed(known)}"
            )


def _check_masses(robot: Robot, links: Sequence[str]) -> None:
    for name in robot.mass_factors:
        if name not in links:
            raise ModelError(
                f'mass_factors has one for "{name}", which is not a link.'
                f"{nearest(name, links)} Links: {listed(links)}"
            )


def _joint(joint: Element, all_settings: Mapping[str, JointSettings]) -> Joint:
    lower, upper = _number(joint, "limit", "lower"), _number(joint, "limit", "upper")
    name = joint.get("name", "")
    if lower > upper:
        raise ModelError(f'joint "{name}" has the lower limit {lower} above the upper {upper}')
    limited = joint.get("type") != "continuous" and lower < upper
    settings = all_settings.get(name, _PLAIN)
    damping, friction = settings.damping, settings.friction
    return Joint(
        name,
        lower if limited else -math.inf,
        upper if limited else math.inf,
        _number(joint, "limit", "velocity") or math.inf,
        _number(joint, "limit", "effort") or math.inf,
        _number(joint, "dynamics", "damping") if damping is None else damping,
        _number(joint, "dynamics", "friction") if friction is None else friction,
        settings,
        "m" if joint.get("type") == "prismatic" else "rad",
    )


def _number(joint: Element, tag: str, attribute: str) -> float:
    """Return a finite number, not negative except in position limits; 0 if it is absent."""
    element = joint.find(tag)
    if element is None:
        return 0.0
    where = f'joint "{joint.get("name")}"'
    (number,) = numbers_of(where, element, attribute, "0", 1)
    if number < 0 and attribute not in ("lower", "upper"):
        raise ModelError(f'{where} has {attribute}="{element.get(attribute)}", which is negative')
    return number


def _links(tree: UrdfTree, joints: Sequence[Joint]) -> list[_Link]:
    moving, found = {joint.name: joint for joint in joints}, []
    for name in tree.links:
        above = tree.parents.get(name)
        if above is None:
            found.append(_Link(name))
            continue
        joint = moving.get(above.get("name", ""))
        axis = (0.0, 0.0, 0.0) if joint is None else _axis(above)
        origin = _origin(f'joint "{above.get("name")}"', above)
        found.append(
            _Link(name, link_of(above, "parent"), above.get("name", ""), origin, joint, axis)
        )
    return found


def _engine_text(links: Sequence[_Link], inertials: Sequence[Inertial]) -> str:
    parts = ['<robot name="robot">']
    for link, inertial in zip(links, inertials, strict=True):
        moments = (f'{k}="{_text(x)}"' for k, x in zip(_MOMENTS, inertial.moments, strict=True))
        parts.append(
            f"<link name={_quote(link.name)}><inertial>{_origin_text(inertial.origin)}"
            f'<mass value="{_text(inertial.mass)}"/><inertia {" ".join(moments)}/>'
            "</inertial></link>"
        )
    for link in links[1:]:
        joint, kind = link.joint, "fixed"
        if joint is not None:
            kind = "prismatic" if joint.unit == "m" else "revolute"
        parts.append(f'<joint name={_quote(link.joint_name)} type="{kind}">')
        parts.append(_origin_text(link.origin))
        parts.append(f"<parent link={_quote(link.parent)}/><child link={_quote(link.name)}/>")
        if joint is not None:
            parts.append(f'<axis xyz="{_text(*link.axis)}"/>{_UNLIMITED}')
        parts.append("</joint>")
    return "".join([*parts, "</robot>"])


def _quote(name: str) -> str:
    if not _SPECIAL.search(name):
        return f'"{name}"'
    from xml.sax.saxutils import quoteattr  # a slow import that is rarely needed

    return quoteattr(name)


def _origin_text(origin: Origin) -> str:
    return f'<origin xyz="{_text(*origin.xyz)}" rpy="{_text(*origin.rpy)}"/>'


def _text(*numbers: float) -> str:
    """Return numbers in the shortest form that every reader reads exactly."""
    return " ".join(repr(float(number)) for number in numbers)


def _bodies(links: Sequence[_Link], inertials: Sequence[Inertial]) -> tuple[RigidBody, ...]:
    places = {link.name: place for place, link in enumerate(links)}
    return tuple(
        RigidBody(
            link.name,
            places.get(link.parent, -1),
            link.origin.matrix(),
            link.joint,
            np.array(link.axis),
            *inertial.in_link(),
        )
        for link, inertial in zip(links, inertials, strict=True)
    )


def _inertial(name: str, link: Element, factor: float) -> Inertial:
    """Return a link's inertia scaled by a factor."""
    given, where = link.find("inertial"), f'link "{name}"'
    element = None if given is None else given.find("mass")
    if given is None or element is None:
        return _NO_INERTIA
    (mass,) = numbers_of(where, element, "value", "0", 1)
    if mass < 0:
        raise ModelError(f'{where} has the mass "{element.get("value")}"')
    inertia = given.find("inertia")
    found = Element("none") if inertia is None else inertia
    moments = [factor * numbers_of(where, found, key, "0", 1)[0] for key in _MOMENTS]
    if not all(map(math.isfinite, [factor * mass, *moments])):
        raise ModelError(f"{where} is too heavy for numbers with its mass factor {factor}")
    if mass == 0 and not any(moments):
        return _NO_INERTIA
    return Inertial(factor * mass or MASSLESS, moments, _origin(where, given))


def _origin(where: str, given: Element) -> Origin:
    origin = given.find("origin")
    if origin is None:
        return Origin()
    return Origin(*(numbers_of(where, origin, key, "0 0 0", 3) for key in ("xyz", "rpy")))


def _axis(joint: Element) -> list[float]:
    """Return a joint's axis as a unit vector."""
    where, element = f'joint "{joint.get("name")}"', joint.find("axis")
    axis = [1.0, 0.0, 0.0] if element is None else numbers_of(where, element, "xyz", "1 0 0", 3)
    length = math.hypot(*axis)
    if not 0 < length < math.inf:
        text = "" if element is None else element.get("xyz")
        raise ModelError(f'{where} has the axis "{text}", which has no direction')
    return [part / length for part in axis]
