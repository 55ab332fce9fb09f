"""URDF files: the tree of links and joints, and the shapes of the links."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from urllib.parse import unquote, urlparse
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from physx_core.errors import listed
from physx_core.files import read_content
from physx_core.rotations import from_roll_pitch_yaw, to_matrix
from physx_core.typing import Vector
from physx_sim.errors import ModelError

_SIZES: dict[str, dict[str, int]] = {
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "mesh": {"scale": 3},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
}
"""Attributes that give the size of each kind of shape, and how many numbers each has."""
_LARGEST = 2**24
"""Maximum size of a URDF file, in bytes."""
_MOST = {"link": 400, "visual": 4000, "collision": 4000}
"""Maximum number of elements in a URDF file; engines' time and memory grow faster than linearly."""


@dataclass(frozen=True, eq=False)
class UrdfShape:
    """A visual or collision shape.

    Attributes:
        kind: ``box``, ``sphere``, ``capsule``, ``cylinder`` or ``mesh``.
        size: In m: edges of a box (3,); radius of a sphere (1,); radius and length of the
            cylindrical part (2,). For a mesh, its scale factors (3,).
        pose: Pose of its center in the link's frame, a homogeneous matrix of shape (4, 4), in m.
        mesh: File name of a mesh, as given in the URDF.
    """

    kind: str
    size: tuple[float, ...]
    pose: Vector
    mesh: str = ""


class UrdfTree:
    """The links and joints of a URDF file, walked depth first with joints sorted by name.

    Attributes:
        root: Root element of the file.
        links: Names of the links, parents before children, the root link first.
        elements: Link elements by name, in file order.
        joints: Joint elements, in the order of the links that they lead to.
        parents: Joint element that leads to each link, by the link's name; none for the root link.
    """

    def __init__(self, root: Element) -> None:
        """Build the tree of a root element returned by `parse_urdf`.

        Raises:
            ModelError: If a name is empty or used twice, or the links do not form a tree; the
                message does not name the file.
        """
        self.root = root
        self.elements = links = _elements_by_name(root, "link")
        children: dict[str, list[Element]] = {name: [] for name in links}
        self.parents: dict[str, Element] = {}
        for name, joint in sorted(_elements_by_name(root, "joint").items()):
            for end in ("parent", "child"):
                if link_of(joint, end) not in links:
                    raise ModelError(
                        f'joint "{name}" has the {end} "{link_of(joint, end)}", which is not a '
                        f"link; links: {listed(links)}"
                    )
            child = link_of(joint, "child")
            if child in self.parents:
                raise ModelError(f'link "{child}" is the child of two joints')
            self.parents[child] = joint
            children[link_of(joint, "parent")].append(joint)
        if not links:
            raise ModelError("it has no link")
        roots = [name for name in links if name not in self.parents]
        if len(roots) != 1:
            found = f"links {listed(roots)} have no parent" if roots else "its joints form a cycle"
            raise ModelError(f"it needs exactly one root link, but {found}")
        self.links = roots
        self.joints: list[Element] = []
        stack = children[roots[0]][::-1]
        while stack:
            self.joints.append(stack.pop())
            child = link_of(self.joints[-1], "child")
            self.links.append(child)
            stack.extend(children[child][::-1])
        if len(self.links) != len(links):
            cut_off = links.keys() - set(self.links)
            raise ModelError(f"links {listed(cut_off)} form a cycle apart from the root")

    def shapes(self, link: str, purpose: str) -> list[UrdfShape]:
        """Return the shapes of a link.

        Args:
            link: Name of the link.
            purpose: ``"visual"`` or ``"collision"``.

        Raises:
            ModelError: If a shape's kind is unknown or a value is not a number.
        """
        where = f'a {purpose} shape of link "{link}"'
        return [_shape(where, element) for element in self.elements[link].findall(purpose)]


def parse_urdf(path: Path) -> Element:
    """Return the root element of a URDF file.

    Raises:
        ModelError: If the file is missing or is not a URDF file.
    """
    try:
        text = read_content(Path(os.path.realpath(path)), _LARGEST)
    except FileNotFoundError:
        raise ModelError(f"There is no URDF file {path}.") from None
    except OSError as error:
        why = error.strerror or error
        raise ModelError(f"{path} cannot be read as a URDF file: {why}.") from error
    if b"\0" in text:
        raise ModelError(f"{path} is UTF-16 or not text; URDF files must be UTF-8.")
    if b"<!DOCTYPE" in text:
        raise ModelError(
            f"{path} has a DOCTYPE, which URDF files do not need and which can hide an XML bomb."
        )
    try:
        root = ElementTree.fromstring(text.lstrip())  # without a DOCTYPE there are no entities
    except ElementTree.ParseError as error:
        raise ModelError(f"{path} is not valid XML: {error}.") from error
    if root.tag != "robot":
        raise ModelError(f'{path} is not a URDF file: its root element is "{root.tag}".')
    for tag, most in _MOST.items():
        count = sum(1 for _ in root.iter(tag))
        if count > most:
            raise ModelError(f'{path} has {count} elements "{tag}"; a model may have {most}.')
    return root


def link_of(joint: Element, end: str) -> str:
    """Return the name of the link at one end, ``"parent"`` or ``"child"``, of a joint element."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def origin_of(where: str, element: Element) -> Vector:
    """Return the pose given by an element's ``origin``, a homogeneous matrix of shape (4, 4).

    Args:
        where: Start of the error message for a value that is not a number.
        element: Element of a joint or shape.

    Raises:
        ModelError: If a value is not a number.
    """
    pose = np.eye(4)
    origin = element.find("origin")
    if origin is not None:
        pose[:3, 3] = numbers_of(where, origin, "xyz", "0 0 0", 3)
        angles = numbers_of(where, origin, "rpy", "0 0 0", 3)
        pose[:3, :3] = to_matrix(from_roll_pitch_yaw(*angles))
    return pose


def numbers_of(
    where: str, element: Element, attribute: str, default: str, count: int
) -> list[float]:
    """Return the numbers in an attribute, separated by blanks or line breaks.

    Args:
        where: Start of the error message, as in ``'joint "knee"'``.
        element: Element with the attribute.
        attribute: Name of the attribute.
        default: Text to use if it is absent.
        count: Required number of numbers.

    Raises:
        ModelError: If they are not `count` finite decimal numbers in ASCII characters.
    """
    text = element.get(attribute, default)
    numbers: list[float] = []
    # Only Python reads 1_0 and digits that are not ASCII.
    if text.isascii() and "_" not in text:
        with contextlib.suppress(ValueError):
            numbers = [float(part) for part in text.split()]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        wanted = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ModelError(f'{where} has {attribute}="{text}", which is not {wanted} such as -2.5e-3')
    return numbers


def mesh_path(model: Path, name: str, package_dirs: Mapping[str, str | Path]) -> Path | None:
    """Return the file that a mesh name refers to, or None if its package is not found.

    Args:
        model: Path of the URDF file; relative names are relative to its folder.
        name: The name as given in the URDF: ``package://...``, ``file://...`` or a path.
        package_dirs: Folder of each package. Other packages are searched for among the folders
            around the URDF file and beside these; at last, the file is, whatever its package is
            called there.
    """
    if name.startswith("file://"):
        return Path(unquote(urlparse(name).path))
    if not name.startswith("package://"):
        return model.parent / name
    package, _, rest = name.removeprefix("package://").partition("/")
    if package in package_dirs:
        return Path(package_dirs[package]) / rest
    around = list(model.parents)
    near = [folder / rest for folder in around if folder.name == package]
    elsewhere = (folder / place for place in (f"{package}/{rest}", rest) for folder in around)
    found = next((file for file in chain(near, elsewhere) if file.is_file()), None)
    return found or (near[0] if near else None)


def _elements_by_name(root: Element, tag: str) -> dict[str, Element]:
    named: dict[str, Element] = {}
    for element in root.findall(tag):
        name = element.get("name", "")
        if not name or name in named:
            raise ModelError(f'a {tag} has the name "{name}", which is empty or used twice')
        named[name] = element
    return named


def _shape(where: str, element: Element) -> UrdfShape:
    geometry = element.find("geometry")
    shape = None if geometry is None or not len(geometry) else geometry[0]
    kind = "none" if shape is None else str(shape.tag)
    if shape is None or kind not in _SIZES:
        raise ModelError(f'{where} is of the kind "{kind}"; known: {listed(_SIZES)}')
    size: list[float] = []
    for name, count in _SIZES[kind].items():
        size += numbers_of(where, shape, name, "1 1 1" if name == "scale" else "", count)
    return UrdfShape(kind, tuple(size), origin_of(where, element), shape.get("filename", ""))
