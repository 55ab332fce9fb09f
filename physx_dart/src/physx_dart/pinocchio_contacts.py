"""Contacts of one robot or object with what never moves, for Pinocchio.

A box touches with its corners, a capsule with the spheres at its ends, a cylinder with three points
of each rim, one of them the deepest; a shape's edges and faces do not touch corners of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio

from physx_core.errors import FeatureNotSupportedError
from physx_core.interfaces.backend import Vector
from physx_dart.parts import Mover, Static
from physx_dart.shapes import Shape
from physx_dart.surfaces import Plane, Surface, surfaces_of

_MARGIN = 1e-4
"""Distance, in m, at which a point counts as touching."""
_RETURN = 0.1
"""Share of a point's depth that it comes back in each step."""
_FASTEST_RETURN = 1.0
"""Speed at which it comes back at most, in m/s."""
_BOUNCE = 0.1
"""Speed of approach, in m/s, from which things bounce."""
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_TURNS = 2 * np.pi / 3 * np.arange(3)


@dataclass(frozen=True, eq=False)
class Touching:
    """Points that touch, or may within the next step.

    Attributes:
        links: Place of each point's link in the robot, shape (k,).
        statics: Place of what it touches among the statics, shape (k,).
        points: In the world frame, in m, shape (k, 3).
        axes: Two tangents and the outward normal of each, as rows, shape (k, 3, 3).
        gaps: Distances, negative inside, in m, shape (k,).
        friction: Coefficients, shape (k,).
        restitution: Coefficients, shape (k,).
        jacobian: Of the points along their axes, shape (3 k, nv).
    """

    links: Vector
    statics: Vector
    points: Vector
    axes: Vector
    gaps: Vector
    friction: Vector
    restitution: Vector
    jacobian: Vector

    def bias(self, before: Vector, period: float) -> Vector:
        """Return what is added to the free velocities along the axes, shape (3 k,).

        Args:
            before: Velocities before the step, shape (nv,).
            period: Length of the step, in s.
        """
        back = np.maximum(_RETURN * self.gaps / period, -_FASTEST_RETURN)
        along = np.where(self.gaps > 0, self.gaps / period, back)
        approach = self.jacobian[2::3] @ before
        bounces = (self.restitution > 0) & (approach < -_BOUNCE)
        along = np.where(bounces, self.restitution * approach, along)
        found = np.zeros(3 * len(along))
        found[2::3] = along
        return found


class ContactFinder:
    """Finds where a robot or object touches what never moves."""

    def __init__(
        self,
        mover: Mover,
        statics: Sequence[Static],
        model: Any,
        frames: Sequence[int],
        features: Sequence[str],
    ) -> None:
        """Prepare the points.

        Raises:
            FeatureNotSupportedError: A shape is a mesh.
        """
        self._model = model
        self._surfaces: list[tuple[int, Static, Surface]] = [
            (place, static, surface)
            for place, static in enumerate(statics)
            for surface in surfaces_of(static, "pinocchio", features)
        ]
        self._up = next(
            (each.normal for _, _, each in self._surfaces if isinstance(each, Plane)),
            np.array([0.0, 0.0, 1.0]),
        )
        links = {name: i for i, name in enumerate(mover.model.links)}
        points: list[tuple[int, Vector, float, int, Shape]] = []
        rims: list[tuple[int, Vector, Vector, int, Shape]] = []
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
                    rims.append((frame.parentJoint, rim, rotation, link, shape))
                continue
            offsets, radius = _points(shape)
            for offset in offsets:
                spot = center + rotation @ offset
                points.append((frame.parentJoint, spot, radius, link, shape))
        self._arrange(points, rims)

    def _arrange(self, points: list[Any], rims: list[Any]) -> None:
        """Put points, then three of each rim, into arrays."""
        rim_points = [row for row in rims for _ in range(3)]
        joints = [row[0] for row in (*points, *rim_points)]
        shapes = [row[4] for row in (*points, *rim_points)]
        self._used = sorted(set(joints))
        self._joints = np.array([self._used.index(joint) for joint in joints], np.intp)
        self._links = np.array([row[3] for row in (*points, *rim_points)], np.intp)
        self._centers = np.array([row[1] for row in (*points, *rim_points)]).reshape(-1, 3)
        self._radii = np.array([*(row[2] for row in points), *(0.0 for _ in rim_points)])
        self._friction = np.array([shape.friction for shape in shapes])
        self._restitution = np.array([shape.restitution for shape in shapes])
        self._rim_joints = np.array([self._used.index(row[0]) for row in rims], np.intp)
        self._rim_axes = np.array([row[2] for row in rims]).reshape(-1, 3, 3)
        self._rim_radii = np.array([row[4].size[0] for row in rims])
        self._rim_centers = np.array([row[1] for row in rims]).reshape(-1, 3)

    def __bool__(self) -> bool:
        """Return whether anything can ever touch."""
        return len(self._joints) > 0

    def find(self, data: Any, q: Vector, v: Vector, period: float) -> Touching | None:
        """Return the points that touch, or may within the next step; None where there are none.

        Args:
            data: What is computed is written to it.
            q: Positions, shape (nq,).
            v: Velocities that the robot would have without contacts, shape (nv,).
            period: Length of the step, in s.
        """
        pinocchio.forwardKinematics(self._model, data, q, v)
        rotations = np.array([data.oMi[joint].rotation for joint in self._used])
        places = np.array([data.oMi[joint].translation for joint in self._used])
        motions = np.array([data.v[joint].vector for joint in self._used])
        if len(self._rim_joints):
            self._centers[len(self._centers) - 3 * len(self._rim_joints) :] = self._rims(rotations)
        turns, moves = rotations[self._joints], motions[self._joints]
        points = np.einsum("nij,nj->ni", turns, self._centers) + places[self._joints]
        local = moves[:, :3] + np.cross(moves[:, 3:], self._centers)
        speeds = np.einsum("nij,nj->ni", turns, local)
        found = []
        for place, static, surface in self._surfaces:
            gaps, normals = surface.distances(points)
            gaps = gaps - self._radii
            ahead = gaps + period * np.einsum("ij,ij->i", normals, speeds)
            near = np.flatnonzero((gaps < _MARGIN) | (ahead < _MARGIN))
            found += [(i, place, static, gaps[i], normals[i], points[i]) for i in near]
        return self._touching(data, q, found) if found else None

    def _rims(self, rotations: Vector) -> Vector:
        """Return three points of each rim in its joint's frame, one of them the deepest."""
        axes = self._rim_axes
        downward = -np.einsum(
            "nji,nkj,k->ni", axes, rotations[self._rim_joints].swapaxes(1, 2), self._up
        )
        first = np.arctan2(downward[:, 1], downward[:, 0])
        first = np.where(np.hypot(downward[:, 0], downward[:, 1]) > 1e-9, first, 0.0)
        angles = first[:, None] + _TURNS
        around = self._rim_radii[:, None, None] * np.stack(
            [np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1
        )
        found = self._rim_centers[:, None] + np.einsum("nij,nkj->nki", axes, around)
        return found.reshape(-1, 3)

    def _touching(self, data: Any, q: Vector, found: list[Any]) -> Touching:
        model, world_axes = self._model, pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        pinocchio.computeJointJacobians(model, data, q)
        points, axes, jacobians = [], [], []
        for i, _, _, gap, normal, center in found:
            joint = self._used[self._joints[i]]
            point = center - (self._radii[i] + 0.5 * min(gap, 0.0)) * normal
            x, y, z = point - data.oMi[joint].translation
            arm = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            whole = pinocchio.getJointJacobian(model, data, joint, world_axes).reshape(6, -1)
            points.append(point)
            axes.append(axes_of(normal))
            jacobians.append(axes[-1] @ (whole[:3] - arm @ whole[3:]))
        rows = np.array([row[0] for row in found])
        materials = [row[2].what for row in found]
        friction = np.array([material.friction for material in materials])
        return Touching(
            links=self._links[rows],
            statics=np.array([row[1] for row in found]),
            points=np.array(points),
            axes=np.array(axes),
            gaps=np.array([row[3] for row in found]),
            friction=np.minimum(self._friction[rows], friction),
            restitution=self._restitution[rows] * [each.restitution for each in materials],
            jacobian=np.concatenate(jacobians),
        )


def axes_of(normal: Vector) -> Vector:
    """Return two tangents and the normal itself as rows, shape (3, 3)."""
    x, y, z = normal
    if abs(z) > 0.5:
        first = np.array([z, 0.0, -x]) / np.hypot(x, z)
    else:
        first = np.array([y, -x, 0.0]) / np.hypot(x, y)
    second = np.array(
        [y * first[2] - z * first[1], z * first[0] - x * first[2], x * first[1] - y * first[0]]
    )
    return np.array([first, second, normal])


def _points(shape: Shape) -> tuple[Vector, float]:
    """Return where spheres are in a shape, and their radius; a radius of 0 is a point."""
    if shape.kind == "box":
        return _CORNERS * np.array(shape.size), 0.0
    if shape.kind == "sphere":
        return np.zeros((1, 3)), shape.size[0]
    ends = np.zeros((2, 3))
    ends[:, 2] = -0.5 * shape.size[1], 0.5 * shape.size[1]
    return ends, shape.size[0]
