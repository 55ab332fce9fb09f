"""Checks of a robot's masses and moments of inertia, when it is loaded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from physx_core.errors import listed
from physx_core.typing import Vector
from physx_sim.engines.models.rigid_bodies import RigidBody, together
from physx_sim.errors import ModelError

MASSLESS = 1e-9
"""Mass, in kg, of links to which the file gives none."""
NEGLIGIBLE = 1e-12
"""Moments of inertia, in kg m², of links to which the file gives neither those nor a mass."""
_ROUNDED = 0.01
"""Relative excess of a moment of inertia that files have because their numbers are rounded."""
_POINT = 1e-9
"""Square of a radius of gyration, in m², below which a body is a point."""


def inertia_warnings(bodies: Sequence[RigidBody], fixed_base: bool) -> tuple[str, ...]:
    """Return what is wrong with the inertia of a robot that can be simulated nevertheless.

    Links that are fixed to each other are judged as one body, since they move as one; those that
    are fixed to the world are not judged.

    Args:
        bodies: The links, parents before children.
        fixed_base: Whether the root link is welded to the world.

    Raises:
        ModelError: If a body has a negative moment of inertia; the message names its links.
    """
    groups = _moving(bodies, fixed_base)
    wholes = [together(bodies, links) for links in groups]
    moments = np.linalg.eigvalsh(np.array([x.inertia for x in wholes]).reshape(-1, 3, 3)).tolist()
    odd: list[str] = []
    for links, whole, (low, middle, high) in zip(groups, wholes, moments, strict=True):
        rounding = max(whole.mass * _POINT, 1e-9 * whole.scale)
        if low < -rounding:
            raise ModelError(
                f"{_links([bodies[link].name for link in links])} has the principal moments of "
                f"inertia {low:.3g}, {middle:.3g} and {high:.3g} kg m²; none may be negative"
            )
        if low + middle < (1 - _ROUNDED) * high - rounding:
            odd.append(bodies[links[0]].name)
    found = []
    if odd:
        found.append(
            f"no body has the moments of inertia of {_links(odd)}: one exceeds the sum of the "
            "other two. Correct them in the file, or expect motions that no body makes"
        )
    weightless = _weightless(bodies, fixed_base)
    if weightless:
        found.append(
            f"{weightless} moved by torques, because the links that move with it have neither mass "
            "nor moments of inertia in the file. Give them an <inertial> element, or impose the "
            'motion with JointSettings(mode="velocity")'
        )
    return tuple(found)


def _links(names: Sequence[str]) -> str:
    return f"{'link' if len(names) == 1 else 'links'} {listed(names)}"


def _moving(bodies: Sequence[RigidBody], fixed_base: bool) -> list[list[int]]:
    """Return the links of each body that can move, as indices, parents before children."""
    groups: dict[int, list[int]] = {}
    first: list[int] = []
    for link, body in enumerate(bodies):
        alone = body.joint is not None or body.parent < 0
        first.append(link if alone else first[body.parent])
        groups.setdefault(first[-1], []).append(link)
    if fixed_base:
        del groups[0]
    return list(groups.values())


def _weightless(bodies: Sequence[RigidBody], fixed_base: bool) -> str:
    """Return the joints that torques move without inertia, as a sentence's start; empty: none."""
    masses = np.array([0.0 if body.mass <= MASSLESS else body.mass for body in bodies])
    if not fixed_base and not masses.any():
        return "the robot cannot be"
    poses: list[Vector] = []
    for body in bodies:
        poses.append(body.pose if body.parent < 0 else poses[body.parent] @ body.pose)
    turns, places = (np.array([pose[:3, part] for pose in poses]) for part in (slice(3), 3))
    centers = places + np.einsum("nij,nj->ni", turns, [body.center for body in bodies])
    inertias = np.array([body.inertia for body in bodies])
    inertias[(masses == 0) & (inertias.max(axis=(1, 2)) <= NEGLIGIBLE)] = 0.0
    inertias = turns @ inertias @ turns.transpose(0, 2, 1)
    # Of each link with all that it carries: mass, mass times position, second moments.
    first = masses[:, None] * centers
    second = np.einsum("n,ni,nj->nij", masses, centers, centers)
    second += 0.5 * np.trace(inertias, axis1=1, axis2=2)[:, None, None] * np.eye(3) - inertias
    for link in range(len(bodies) - 1, 0, -1):
        for each in (masses, first, second):
            each[bodies[link].parent] += each[link]
    axes = np.einsum("nij,nj->ni", turns, [body.axis for body in bodies])
    cross = np.einsum("ni,nj->nij", first, places)
    about = second - cross - cross.transpose(0, 2, 1)
    about += np.einsum("n,ni,nj->nij", masses, places, places)
    moved = np.trace(about, axis1=1, axis2=2) - np.einsum("nij,ni,nj->n", about, axes, axes)
    rounding = 1e-13 * np.abs(np.trace(second, axis1=1, axis2=2))
    names = [
        body.joint.name
        for link, body in enumerate(bodies)
        if body.joint is not None
        and body.joint.mode != "velocity"
        and not body.joint.armature
        and (masses[link] == 0 if body.joint.unit == "m" else moved[link] <= rounding[link])
    ]
    if not names:
        return ""
    return f"joint {names[0]} cannot be" if len(names) == 1 else f"joints {listed(names)} cannot be"
