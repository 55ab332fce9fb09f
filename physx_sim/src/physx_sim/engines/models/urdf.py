"""Robot models from URDF files.

The engines' own readers of URDF disagree, so all engines get the numbers read here, and a file
means the same in each of them:

- `physx_sim.engines.models.shapes` reads the collision shapes, whose meshes must exist.
- A link without mass gets 1e-9 kg and, unless it has moments of inertia, 1e-12 kg m².
- A joint that follows another (mimic) with the multiplier 0 stays an ordinary one, with a warning.
- A position limit whose ends are equal or absent, or a velocity or effort limit that is 0 or
  absent, counts as no limit: many files contain zeros for unknown limits. So does, with a warning,
  a lower limit above the upper one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from physx_core.errors import listed
from physx_sim import (
    JointSettings,
    Mimic,
    Robot,
    UrdfTree,
    link_of,
    numbers_of,
    parse_urdf,
)
from physx_sim.engines.models.inertias import MASSLESS, NEGLIGIBLE
from physx_sim.engines.models.rigid_bodies import Inertial, Joint, Origin, RigidBody
from physx_sim.engines.models.robot_files import missing_meshes
from physx_sim.engines.models.robot_model import RobotModel, check_names, coupled
from physx_sim.engines.models.shapes import shapes_of_robot
from physx_sim.errors import MissingMeshesError, ModelError

_MOVING = ("revolute", "continuous", "prismatic")
_PLAIN = JointSettings()
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_NO_INERTIA = Inertial(MASSLESS, (NEGLIGIBLE, NEGLIGIBLE, NEGLIGIBLE, 0.0, 0.0, 0.0))


def read_urdf(robot: Robot, path: Path, *, touching: bool) -> RobotModel:
    """Read a robot's URDF file.

    The tree is walked depth first, with the children of a link sorted by joint name.

    Args:
        robot: The robot's description.
        path: Its file.
        touching: Whether to read its collision shapes.
    """
    root = parse_urdf(path)
    tree = UrdfTree(root)
    if not robot.fixed_base and tree.links[0] == "world":
        raise ModelError("its root link is the world, which cannot float; use fixed_base=True")
    for joint in tree.joints:
        if joint.get("type", "") not in (*_MOVING, "fixed"):
            name, kind = joint.get("name"), joint.get("type", "")
            advice = ": use three hinges" if kind == "spherical" else ""
            raise ModelError(
                f'joint "{name}" has the type "{kind}", which is not supported{advice}'
            )
    if robot.root not in ("", tree.links[0]):
        raise ModelError(f'its root is "{tree.links[0]}", not "{robot.root}"')
    moving = [joint for joint in tree.joints if joint.get("type") in _MOVING]
    check_names(robot, list(tree.links), [joint.get("name", "") for joint in moving])
    doubts = (*_odd_joints(moving), *_missing_meshes(robot, path, root))
    places = {name: place for place, name in enumerate(tree.links)}
    bodies = tuple(_body(robot, tree, name, places) for name in tree.links)
    shapes = shapes_of_robot(robot, path, tree) if touching else ()
    return coupled(robot, RobotModel(path, bodies, shapes, doubts), _mimics(moving))


def _odd_joints(moving: Sequence[Element]) -> Iterator[str]:
    """Yield what of the movable joints is not simulated as the file says."""
    limits = [[_number(joint, "limit", end) for end in ("lower", "upper")] for joint in moving]
    names = [joint.get("name", "") for joint in moving]
    unlimited = [name for name, (low, high) in zip(names, limits, strict=True) if low > high]
    if unlimited:
        yield f"the lower limit is above the upper, so there is none: joints {listed(unlimited)}"
    still = [joint.get("name", "") for joint in moving if _multiplier(joint) == 0]
    if still:
        yield f"joints that follow others with the multiplier 0 move freely: {listed(still)}"


def _multiplier(joint: Element) -> float | None:
    """Return the multiplier of a joint that follows another; None if it follows none."""
    element = joint.find("mimic")
    if element is None:
        return None
    return numbers_of(f'joint "{joint.get("name")}"', element, "multiplier", "1", 1)[0]


def _mimics(moving: Sequence[Element]) -> dict[str, Mimic]:
    """Return how joints follow others, by name."""
    found = {}
    for joint in moving:
        element, multiplier = joint.find("mimic"), _multiplier(joint)
        if element is not None and multiplier:
            name = joint.get("name", "")
            (offset,) = numbers_of(f'joint "{name}"', element, "offset", "0", 1)
            found[name] = Mimic(element.get("joint", ""), multiplier, offset)
            if not found[name].leader:
                raise ModelError(f'joint "{name}" follows (mimic) a joint without a name')
    return found


def _missing_meshes(robot: Robot, path: Path, root: Element) -> Iterator[str]:
    """Yield which meshes do not exist, which is an error if they are needed for collisions."""
    if robot.collisions != "none":
        needed = missing_meshes(path, root.findall("link/collision"), robot.package_dirs)
        if needed:
            raise MissingMeshesError(str(path), needed)
    missing = missing_meshes(path, [root], robot.package_dirs)
    if missing:
        yield f"{len(missing)} mesh file(s) do not exist, so they are not drawn: {listed(missing)}"


def _body(robot: Robot, tree: UrdfTree, name: str, places: Mapping[str, int]) -> RigidBody:
    factor = float(robot.mass_factors.get(name, 1.0))
    inertia = _inertial(name, tree.elements[name], factor).in_link()
    above = tree.parents.get(name)
    if above is None:
        return RigidBody(name, -1, np.eye(4), None, np.zeros(3), *inertia)
    joint, axis = None, np.zeros(3)
    if above.get("type") in _MOVING:
        joint, axis = _joint(above, robot.joints), np.array(_axis(above))
    pose = _origin(f'joint "{above.get("name")}"', above).matrix()
    return RigidBody(name, places[link_of(above, "parent")], pose, joint, axis, *inertia)


def _joint(joint: Element, all_settings: Mapping[str, JointSettings]) -> Joint:
    lower, upper = _number(joint, "limit", "lower"), _number(joint, "limit", "upper")
    name = joint.get("name", "")
    limited = joint.get("type") != "continuous" and lower < upper
    settings = all_settings.get(name, _PLAIN)
    return Joint(
        name,
        lower if limited else -math.inf,
        upper if limited else math.inf,
        _number(joint, "limit", "velocity") or math.inf,
        _number(joint, "limit", "effort") or math.inf,
        settings.mode,
        settings.gain,
        "m" if joint.get("type") == "prismatic" else "rad",
        **settings.resistance(
            damping=_number(joint, "dynamics", "damping"),
            friction=_number(joint, "dynamics", "friction"),
        ),
        mimic=None,
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
