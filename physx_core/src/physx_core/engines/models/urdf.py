"""Robot models from URDF files: names, joints, collision shapes, and URDF text for the engines.

All engines load the same text, rebuilt from the file: links with their inertia, joints with their
origin and axis. Everything else is read here, so it means the same in every engine:

- Shapes are omitted; `physx_core.engines.models.shapes` reads those for collisions. All meshes must
  exist.
- A link without inertia, or with mass 0, gets 1e-9 kg and 1e-12 kg m².
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
from xml.etree.ElementTree import Element

from physx_core.engines.models.robot_files import check_meshes, find_robot
from physx_core.engines.models.shapes import CollisionShape, shapes_of_robot
from physx_core.errors import ModelError, listed, nearest
from physx_core.simulation import (
    JointSettings,
    Robot,
    UrdfTree,
    link_of,
    numbers_of,
    parse_urdf,
)

_MOVING = ("revolute", "continuous", "prismatic")
_UNLIMITED = '<limit lower="-1e9" upper="1e9" effort="1e9" velocity="1e9"/>'
_PLAIN = JointSettings()
_SPECIAL = re.compile('[&<>"\t\n\r]')
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_NEGLIGIBLE = (
    '<inertial><mass value="1e-9"/><inertia ixx="1e-12" iyy="1e-12" izz="1e-12" '
    'ixy="0" ixz="0" iyz="0"/></inertial>'
)


@dataclass(frozen=True)
class Joint:
    """A joint with one degree of freedom.

    Attributes:
        name: Name in the file.
        lower: Lower position limit, in rad or m; -inf: none.
        upper: Upper position limit, in rad or m; inf: none.
        max_velocity: Limit of the velocity, in rad/s or m/s.
        max_torque: Limit of the torque, in N m or N.
        damping: Viscous damping, in N m s/rad or N s/m.
        friction: Coulomb friction, in N m or N.
        settings: The world's settings for it.
        unit: Unit of its position, rad or m.
    """

    name: str
    lower: float
    upper: float
    max_velocity: float
    max_torque: float
    damping: float
    friction: float
    settings: JointSettings
    unit: str


@dataclass(frozen=True)
class RobotModel:
    """The model of a robot.

    Attributes:
        path: Absolute path of the file.
        text: URDF text for the engines.
        links: Names of all links, parents before children, in tree order.
        joints: The joints with one degree of freedom, in tree order.
        shapes: Collision shapes; empty if there is nothing to touch.
    """

    path: Path
    text: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    shapes: tuple[CollisionShape, ...] = ()


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
        text = _engine_text(tree, robot.mass_factors)
        shapes = shapes_of_robot(robot, path, tree) if touching else ()
    except (ModelError, ValueError) as error:
        raise ModelError(f'Robot "{robot.name}", {path}: {error}.') from error
    return RobotModel(path, text, tuple(tree.links), joints, shapes)


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
    """Return a finite number; 0 if it is absent."""
    element = joint.find(tag)
    text = "0" if element is None else element.get(attribute, "0")
    signed = attribute in ("lower", "upper")
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (number < 0 and not signed):
        raise ModelError(f'joint "{joint.get("name")}" has {attribute}="{text}"')
    return number


def _engine_text(tree: UrdfTree, mass_factors: Mapping[str, float]) -> str:
    parts = ['<robot name="robot">']
    for name in tree.links:
        link = _inertial(name, tree.elements[name], mass_factors.get(name, 1.0))
        parts.append(f"<link name={_quote(name)}>{link}</link>")
    for joint in tree.joints:
        moving = joint.get("type") in _MOVING
        kind = "prismatic" if joint.get("type") == "prismatic" else "revolute"
        name = joint.get("name", "")
        parts.append(f'<joint name={_quote(name)} type="{kind if moving else "fixed"}">')
        parts.append(_origin(f'joint "{name}"', joint))
        for tag in ("parent", "child"):
            parts.append(f"<{tag} link={_quote(link_of(joint, tag))}/>")
        if moving:
            parts.append(f'<axis xyz="{_axis(joint)}"/>{_UNLIMITED}')
        parts.append("</joint>")
    return "".join([*parts, "</robot>"])


def _quote(name: str) -> str:
    if not _SPECIAL.search(name):
        return f'"{name}"'
    from xml.sax.saxutils import quoteattr  # a slow import that is rarely needed

    return quoteattr(name)


def _inertial(name: str, link: Element, factor: float) -> str:
    """Return the text of a link's inertia scaled by a factor, with each number validated."""
    given, where = link.find("inertial"), f'link "{name}"'
    mass = None if given is None else given.find("mass")
    if given is None or mass is None or _checked_text(where, mass, "value", "0", 1) == "0":
        return _NEGLIGIBLE
    if float(mass.get("value", "0")) < 0:
        raise ModelError(f'{where} has the mass "{mass.get("value")}"')
    inertia = given.find("inertia")
    found = Element("none") if inertia is None else inertia
    values = {key: _checked_text(where, found, key, "0", 1) for key in _MOMENTS}
    value = mass.get("value", "")
    if factor != 1.0:
        values = {key: repr(factor * float(text)) for key, text in values.items()}
        value = repr(factor * float(value))
    moments = " ".join(f'{key}="{text}"' for key, text in values.items())
    origin = _origin(where, given)
    return f'<inertial>{origin}<mass value="{value}"/><inertia {moments}/></inertial>'


def _origin(where: str, given: Element) -> str:
    origin = given.find("origin")
    if origin is None:
        return ""
    xyz, rpy = (_checked_text(where, origin, key, "0 0 0", 3) for key in ("xyz", "rpy"))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def _checked_text(where: str, element: Element, attribute: str, default: str, count: int) -> str:
    """Return the text of an attribute that must be finite numbers; "0" for a number equal to 0."""
    numbers = numbers_of(where, element, attribute, default, count)
    return element.get(attribute, default) if any(numbers) or count > 1 else "0"


def _axis(joint: Element) -> str:
    element = joint.find("axis")
    text = "1 0 0" if element is None else element.get("xyz", "1 0 0")
    axis = [float(part) for part in text.split()]
    length = math.hypot(*axis)
    if len(axis) != 3 or not 0 < length < math.inf:
        raise ModelError(f'joint "{joint.get("name")}" has the axis "{text}"')
    if length == 1.0:
        return text
    return " ".join(repr(part / length) for part in axis)
