"""Contacts of a robot or object with static things, for Pinocchio.

A box collides with its corners, a capsule with the spheres at its ends, a cylinder with three
points of each rim, one of them the deepest; edges and faces do not collide with corners of others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio
from numpy.typing import NDArray

from physx_core.errors import FeatureNotSupportedError
from physx_core.typing import Vector
from physx_dart.models.parts import Mover, Static
from physx_dart.models.shapes import CollisionShape
from physx_dart.pinocchio.surfaces import Plane, Surface, surfaces_of

_MARGIN = 1e-4
"""Distance, in m, below which a point counts as touching."""
_RETURN = 0.1
"""Share of a point's penetration that is corrected in each step."""
_FASTEST_RETURN = 1.0
"""Largest speed of this correction, in m/s."""
_BOUNCE = 0.1
"""Approach speed, in m/s, above which things bounce."""
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_THIRDS = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
"""Cosines and sines of three directions around a rim."""
_CROSS = np.zeros((3, 9))
_CROSS[[0, 0, 1, 1, 2, 2], [7, 5, 2, 6, 3, 1]] = 1.0, -1.0, 1.0, -1.0, 1.0, -1.0
"""Maps a vector to its cross-product matrix, flattened by rows."""


Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ContactPoints:
    """Points that touch, or may touch within the next step.

    Attributes:
        links: Index of each point's link in the robot, shape (k,).
        statics: Index of the static thing that it touches, shape (k,).
        numbers: Number of each, by which it is found again in the next step, shape (k,).
        points: In the world frame, in m, shape (k, 3).
        axes: Two tangents and the outward normal of each, as rows, shape (k, 3, 3).
        gaps: Distances, negative inside, in m, shape (k,).
        friction: Coefficients, shape (k,).
        restitution: Coefficients, shape (k,).
        jacobian: Of the points along their axes, shape (3 k, nv).
    """

    links: Indices
    statics: Indices
    numbers: Indices
    points: Vector
    axes: Vector
    gaps: Vector
    friction: Vector
    restitution: Vector
    jacobian: Vector

    def bias(self, before: Vector, period: float) -> Vector:
        """Return the bias of the velocities along the axes, shape (3 k,).

        Args:
            before: Velocities before the step, shape (nv,).
            period: Length of the step, in s.
        """
        pace = self.gaps / period
        along = np.where(self.gaps > 0, pace, np.maximum(_RETURN * pace, -_FASTEST_RETURN))
        if self.restitution.any():
            approach = self.jacobian[2::3] @ before
            bounces = (self.restitution > 0) & (approach < -_BOUNCE)
            along = np.where(bounces, self.restitution * approach, along)
        found = np.zeros(3 * len(along))
        found[2::3] = along
        return found


@dataclass(frozen=True, eq=False)
class _NearPoints:
    """Points near a surface: as `ContactPoints`, with their rows in the finder and their radii."""

    statics: Indices
    numbers: Indices
    rows: Indices
    gaps: Vector
    normals: Vector
    axes: Vector
    points: Vector
    radii: Vector

    @classmethod
    def at(
        cls,
        place: int,
        surface: Surface,
        numbers: Indices,
        rows: Indices,
        gaps: Vector,
        normals: Vector,
        points: Vector,
        radii: Vector,
    ) -> _NearPoints:
        """Add the tangents at the surface of the static thing with that index."""
        if isinstance(surface, Plane):
            axes = np.ones((len(rows), 1, 1)) * np.array(axes_of(*surface.normal.tolist()))
        else:
            axes = np.array([axes_of(*normal) for normal in normals.tolist()])
        return cls(np.full(len(rows), place), numbers, rows, gaps, normals, axes, points, radii)


class ContactFinder:
    """Finds the contacts of a robot or object with static things."""

    def __init__(
        self,
        mover: Mover,
        statics: Sequence[Static],
        model: Any,
        data: Any,
        frames: Sequence[int],
        features: Sequence[str],
    ) -> None:
        """Prepare the points; `find` uses the model and its data."""
        self._model, self._data = model, data
        self._surfaces = [
            (place, surface)
            for place, static in enumerate(statics)
            for surface in surfaces_of(static, "pinocchio", features)
        ]
        self._up = next(
            (each.normal for _, each in self._surfaces if isinstance(each, Plane)),
            np.array([0.0, 0.0, 1.0]),
        )
        links = {name: i for i, name in enumerate(mover.model.links)}
        points: list[tuple[int, Vector, float, int, CollisionShape]] = []
        rims: list[tuple[int, Vector, float, int, CollisionShape, Vector]] = []
        for shape in mover.model.shapes if self._surfaces else ():
            if shape.kind == "mesh":
                advice = 'Use Robot(collisions="boxes") or "capsules".'
                raise FeatureNotSupportedError("pinocchio", "mesh_contacts", features, advice)
            link = links.get(shape.body, 0)
            frame = model.frames[frames[link]]
            turn, place = frame.placement.rotation, frame.placement.translation
            rotation, center = turn @ shape.rotation, turn @ shape.position + place
            if shape.kind == "cylinder":
                for end in (-0.5, 0.5):
                    rim = center + end * shape.size[1] * rotation[:, 2]
                    rims.append((frame.parentJoint, rim, shape.size[0], link, shape, rotation))
                continue
            offsets, radius = _points(shape)
            for offset in offsets:
                spot = center + rotation @ offset
                points.append((frame.parentJoint, spot, radius, link, shape))
        anchors: list[Any] = [*points, *rims]
        self._arrange(anchors, len(points))
        materials, shapes = [static.what for static in statics], [row[4] for row in anchors]
        of_materials = np.array([(each.friction, each.restitution) for each in materials])
        of_shapes = np.array([(shape.friction, shape.restitution) for shape in shapes])
        first, second = of_materials.reshape(-1, 1, 2), of_shapes.reshape(1, -1, 2)
        self._friction = np.minimum(first[:, :, 0], second[:, :, 0])
        self._restitution = first[:, :, 1] * second[:, :, 1]

    def _arrange(self, anchors: list[Any], points: int) -> None:
        """Collect points, then the centers of rims, in arrays."""
        used = sorted({row[0] for row in anchors})
        model, data = self._model, self._data
        # Views of Pinocchio's memory, which change with each `find`.
        self._turns = [data.oMi[joint].rotation for joint in used]
        self._places = [data.oMi[joint].translation for joint in used]
        self._moved = np.zeros((len(used), model.nv))
        for row, joint in enumerate(used):
            for each in (each for each in model.supports[joint] if each > 0):
                first = model.idx_vs[each]
                self._moved[row, first : first + model.nvs[each]] = 1.0
        self._joints = np.array([used.index(row[0]) for row in anchors], np.intp)
        self._links = np.array([row[3] for row in anchors], np.intp)
        self._centers = np.array([row[1] for row in anchors]).reshape(-1, 3)
        self._radii = np.array([row[2] for row in anchors])
        self._first_rim = points
        self._rim_axes = np.array([row[5] for row in anchors[points:]]).reshape(-1, 3, 3)

    def __bool__(self) -> bool:
        """Return whether anything can ever touch."""
        return len(self._joints) > 0

    def __len__(self) -> int:
        """Return an upper bound of `ContactPoints.numbers`."""
        return 3 * len(self._links) * len(self._friction)

    def find(self, q: Vector, v: Vector, period: float) -> ContactPoints | None:
        """Return the points that touch, or may within the next step; None if there are none.

        Args:
            q: Positions, shape (nq,).
            v: Velocities that the robot would have without contacts, shape (nv,).
            period: Length of the step, in s.
        """
        motions = pinocchio.computeJointJacobians(self._model, self._data, q)
        joints, turns = self._joints, np.array(self._turns)
        points = np.einsum("nij,nj->ni", turns[joints], self._centers)
        points += np.array(self._places)[joints]
        # Motion of each joint in the step: rotation, and translation at the world's origin.
        twists = period * ((self._moved * v) @ motions.T)
        steps = _displacements(twists[joints], points)
        reach, first = self._radii, self._first_rim
        if first < len(points):
            # A point of a rim moves no further than its center plus the effect of its rotation.
            spins, reach = _lengths(twists[:, 3:])[joints[first:]], reach.copy()
            reach[first:] += _lengths(steps[first:]) + reach[first:] * spins
        found: list[_NearPoints] = []
        for place, surface in self._surfaces:
            gaps, normals = surface.distances(points)
            ahead = gaps + np.einsum("ij,ij->i", normals, steps)
            close = np.minimum(gaps, ahead) < reach + _MARGIN
            if not surface.even:
                close[first:] = True
            rows = np.flatnonzero(close)
            if len(rows) and rows[-1] >= first:
                rows, rims = rows[rows < first], rows[rows >= first]
                found += self._near_rims(place, surface, rims, turns, points, twists)
            if len(rows):
                radii = self._radii[rows]
                gaps, normals = gaps[rows] - radii, normals[rows]
                found.append(
                    _NearPoints.at(place, surface, rows, rows, gaps, normals, points[rows], radii)
                )
        return self._touching(motions, found) if found else None

    def _near_rims(
        self,
        place: int,
        surface: Surface,
        rims: Indices,
        turns: Vector,
        points: Vector,
        twists: Vector,
    ) -> list[_NearPoints]:
        """Return the points of rims that touch, or may within the next step."""
        rows, around = np.repeat(rims, 3), self._rims(rims, turns, points)
        numbers = 3 * rows + np.tile([0, 1, 2], len(rims))
        gaps, normals = surface.distances(around)
        steps = _displacements(twists[self._joints[rows]], around)
        close = np.minimum(gaps, gaps + np.einsum("ij,ij->i", normals, steps)) < _MARGIN
        if not close.any():
            return []
        rows, gaps, normals, around = rows[close], gaps[close], normals[close], around[close]
        numbers, radii = numbers[close], np.zeros(len(rows))
        return [_NearPoints.at(place, surface, numbers, rows, gaps, normals, around, radii)]

    def _rims(self, rows: Indices, turns: Vector, points: Vector) -> Vector:
        """Return three points of each rim, one of them the deepest, shape (3 rows, 3)."""
        axes = turns[self._joints[rows]] @ self._rim_axes[rows - self._first_rim]
        along = axes[:, :, 2]
        downward = (along @ self._up)[:, None] * along - self._up
        lengths = _lengths(downward)[:, None]
        upright = lengths <= 1e-9
        first = np.where(upright, axes[:, :, 0], downward / np.where(upright, 1.0, lengths))
        around = _THIRDS @ np.stack([first, np.cross(along, first)], axis=1)
        return (points[rows][:, None] + self._radii[rows][:, None, None] * around).reshape(-1, 3)

    def _touching(self, motions: Vector, found: list[_NearPoints]) -> ContactPoints:
        rows, statics = _concatenate(found, "rows"), _concatenate(found, "statics")
        gaps, normals = _concatenate(found, "gaps"), _concatenate(found, "normals")
        depths = _concatenate(found, "radii") + 0.5 * np.minimum(gaps, 0.0)
        points = _concatenate(found, "points") - depths[:, None] * normals
        axes = _concatenate(found, "axes")
        turned = (points @ _CROSS).reshape(-1, 3, 3) @ motions[3:]
        jacobian = axes @ ((motions[:3] - turned) * self._moved[self._joints[rows], None])
        return ContactPoints(
            links=self._links[rows],
            statics=statics,
            numbers=3 * len(self._links) * statics + _concatenate(found, "numbers"),
            points=points,
            axes=axes,
            gaps=gaps,
            friction=self._friction[statics, rows],
            restitution=self._restitution[statics, rows],
            jacobian=jacobian.reshape(-1, jacobian.shape[2]),
        )


def axes_of(x: float, y: float, z: float) -> tuple[tuple[float, float, float], ...]:
    """Return two tangents and the normal (x, y, z) itself."""
    if abs(z) > 0.5:
        length = math.hypot(x, z)
        a, b, c = z / length, 0.0, -x / length
    else:
        length = math.hypot(x, y)
        a, b, c = y / length, -x / length, 0.0
    return (a, b, c), (y * c - z * b, z * a - x * c, x * b - y * a), (x, y, z)


def _displacements(twists: Vector, points: Vector) -> Vector:
    """Return the displacements of points (n, 3) by translations and rotations (n, 6)."""
    return twists[:, :3] + np.einsum(
        "nij,nj->ni", (twists[:, 3:] @ _CROSS).reshape(-1, 3, 3), points
    )


def _lengths(vectors: Vector) -> Vector:
    """Return the lengths of rows."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def _concatenate(found: list[_NearPoints], name: str) -> Any:
    """Return an attribute of all near points as one array."""
    parts = [getattr(each, name) for each in found]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _points(shape: CollisionShape) -> tuple[Vector, float]:
    """Return the centers of spheres in a shape and their radius; a radius of 0 is a point."""
    if shape.kind == "box":
        return _CORNERS * np.array(shape.size), 0.0
    if shape.kind == "sphere":
        return np.zeros((1, 3)), shape.size[0]
    ends = np.zeros((2, 3))
    ends[:, 2] = -0.5 * shape.size[1], 0.5 * shape.size[1]
    return ends, shape.size[0]
