"""Comparison of a robot as an engine holds it with its file as physx read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from physx_core.errors import listed
from physx_core.rotations import to_matrix
from physx_core.typing import Vector
from physx_sim.engines.models.parts import MovableBody
from physx_sim.engines.models.rigid_bodies import RigidBody, together
from physx_sim.errors import ModelError

_TOLERANCE = 1e-9
"""Difference up to which numbers are equal, relative to the largest of the same link or joint."""


@dataclass(frozen=True, eq=False)
class LoadedBody:
    """One or more links that cannot move relative to each other, as an engine holds them.

    Attributes:
        links: Indices of the links in the model.
        mass: Their mass, in kg.
        center: Center of mass in the frame of the first link, shape (3,), in m.
        inertia: Moments of inertia about it there, shape (3, 3), in kg m².
    """

    links: Sequence[int]
    mass: float
    center: Vector
    inertia: Vector


@dataclass(frozen=True, eq=False)
class LoadedRobot:
    """A robot or object as an engine holds it after loading.

    Attributes:
        poses: Frame of each link relative to its parent's with the joint at 0, that of the root
            link in the world, shape (links, 4, 4); a floating root has the identity.
        axes: Axis of each joint in its own frame, shape (joints, 3).
        bodies: The links' inertia; links that are omitted cannot move.
        limits: What the engine holds of the joints by the name of the attribute of `Joint`, such as
            ``"lower"``, shape (joints,) each.
    """

    poses: Vector
    axes: Vector
    bodies: Sequence[LoadedBody]
    limits: Mapping[str, Vector] = field(default_factory=dict)


def check_loaded(engine: str, movable: MovableBody, loaded: LoadedRobot) -> None:
    """Check that an engine holds a robot or object as physx read it.

    An engine calls it whenever it has loaded a model: a reader that silently drops what it does not
    understand would otherwise simulate another robot.

    Args:
        engine: Name of the engine.
        movable: The robot or object.
        loaded: What the engine holds.

    Raises:
        ModelError: If they differ; the message names link or joint, quantity and both values.
    """
    bodies, joints = movable.model.bodies, movable.model.joints
    names = [f'link "{body.name}"' for body in bodies]
    poses = np.array([body.pose for body in bodies])
    if movable.fixed_base:
        poses[0, :3, :3], poses[0, :3, 3] = to_matrix(movable.orientation), movable.position
    where = _Where(engine, movable)
    where.compare(names, "position", loaded.poses[:, :3, 3], poses[:, :3, 3], 1.0)
    where.compare(names, "rotation", loaded.poses[:, :3, :3], poses[:, :3, :3], 1.0)
    axes = [body.axis for body in bodies if body.joint is not None]
    of_joints = [f'joint "{joint.name}"' for joint in joints]
    where.compare(of_joints, "axis", loaded.axes, np.array(axes).reshape(-1, 3), 1.0)
    for name, values in loaded.limits.items():
        wanted = np.array([getattr(joint, name) for joint in joints], np.float64)
        where.compare(of_joints, name, values, wanted, 0.0)
    _compare_inertia(where, bodies, loaded.bodies)


def _compare_inertia(
    where: _Where, bodies: Sequence[RigidBody], loaded: Sequence[LoadedBody]
) -> None:
    names = [_names([bodies[link].name for link in each.links]) for each in loaded]
    wanted = [together(bodies, each.links) for each in loaded]
    masses = np.array([each.mass for each in wanted])
    found = np.array([each.mass for each in loaded])
    where.compare(names, "mass", found, masses, 0.0)
    inertias = np.array([each.inertia for each in wanted])
    found = np.array([each.inertia for each in loaded])
    rounding = np.array([each.scale for each in wanted])
    where.compare(names, "inertia", found, inertias, rounding)
    centers = np.array([each.center for each in wanted])
    found = np.array([each.center for each in loaded])
    where.compare(names, "center of mass", found, centers, 1.0)


def _names(links: Sequence[str]) -> str:
    return (
        f'link "{links[0]}"' if len(links) == 1 else f"links {listed(links)}, which are one body,"
    )


@dataclass(frozen=True)
class _Where:
    """Which engine holds which robot."""

    engine: str
    movable: MovableBody

    def compare(
        self, names: Sequence[str], what: str, found: Vector, wanted: Vector, scale: float | Vector
    ) -> None:
        """Raise an error if numbers differ.

        Args:
            names: Whose they are, one for each row.
            what: What they are.
            found: The engine's.
            wanted: Those of the file.
            scale: Smallest number to which rounding errors are relative; one, or one for each row.
        """
        rows = len(names)
        if not rows or np.array_equal(found, wanted):  # mostly, and much faster
            return
        left, right = found.reshape(rows, -1), wanted.reshape(rows, -1)
        with np.errstate(invalid="ignore"):  # infinite limits
            largest = np.abs(right).max(axis=1, initial=0.0)
            bounds = _TOLERANCE * np.maximum(largest, scale)[:, None]
            same = ((left == right) | (np.abs(left - right) <= bounds)).all(axis=1)
        if same.all():
            return
        row = int(np.argmin(same))
        raise ModelError(
            f'Robot "{self.movable.name}", {self.movable.model.path}: the engine {self.engine} '
            f"gives {names[row]} the {what} {found[row].tolist()} instead of "
            f"{wanted[row].tolist()}. It cannot simulate this file; please report it."
        )
