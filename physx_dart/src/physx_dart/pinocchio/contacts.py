"""Contacts of a robot or object with planes and height fields.

A box touches them with its corners, a capsule with the spheres at its ends, and a cylinder with
three points on each rim, including the deepest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio
from numpy.typing import NDArray

from physx_core.rotations import cross_rows
from physx_core.typing import Records, Vector
from physx_dart.pinocchio.models import twists_of
from physx_dart.pinocchio.surfaces import Heights, Plane, Surface, surface_of
from physx_sim import CONTACT, Ground, HeightField, Stairs
from physx_sim.engines import CollisionShape, MovableBody, Static
from physx_sim.errors import FeatureNotSupportedError, SimulationError

MARGIN = 1e-4
"""Distance, in m, below which a point counts as touching."""
_RETURN = 0.1
"""Fraction of a point's penetration that is corrected in each step."""
_FASTEST_RETURN = 0.1
"""Maximum speed of this correction, in m/s: a body that is pushed out faster jumps visibly."""
_BOUNCE = 0.1
"""Approach speed, in m/s, above which contacts bounce."""
_FLAT = 1e-9
"""Sine of the angle between a rim's axis and the normal up to which it lies flat."""
_FARTHEST_RUN = 0.3
"""Angle, in rad, that the deepest point of a rim may run along it in a step to count as rolling."""
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_THIRDS = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
"""Cosines and sines of three directions around a rim."""

# Arrays, because NumPy takes twice as long with numbers.
_ZERO, _HALF, _NEAR = np.array(0.0), np.array(0.5), np.array(MARGIN)

Indices = NDArray[np.intp]


@dataclass(eq=False, slots=True)
class Spins:
    """Friction that acts against turning at contact points.

    Attributes:
        points: Which of the contact points have it, shape (s,).
        bounds: Largest torques per normal force against rolling, and about the normal, in m, shape
            (s, 2).
        jacobian: Jacobian of the angular velocities along the axes of these points, shape
            (3 s, nv).
        drift: Angular velocities along the axes of what they touch, in rad/s, shape (3 s,).
        impulses: Angular impulses on the first body along the axes, in N m s, shape (s, 3); filled
            by the step, also where the points were widened.
    """

    points: Indices
    bounds: Vector
    jacobian: Vector
    drift: Vector
    impulses: Vector

    @classmethod
    def of(cls, bounds: Vector, axes: Vector, motions: Vector, moved: Vector) -> Spins | None:
        """Return the friction against turning of points, or None.

        Args:
            bounds: For each point, as in `Spins`, shape (k, 2).
            axes: Two tangents and the normal of each, shape (k, 3, 3).
            motions: Twists for unit velocities, shape (6, nv).
            moved: How much of each the points take part in, shape (k, nv).
        """
        rows = np.flatnonzero(bounds.any(axis=1))
        if not len(rows):
            return None
        jacobian = axes[rows] @ motions[3:] * moved[rows, None]
        flat = jacobian.reshape(3 * len(rows), -1)
        return cls(rows, bounds[rows], flat, np.zeros(len(flat)), np.zeros((len(rows), 3)))


@dataclass(eq=False, slots=True)
class ContactPoints:
    """Points that touch, or may touch within the next step.

    Attributes:
        numbers: Number of each, which identifies it in the next step, shape (k,).
        points: Positions in the world frame, in m, shape (k, 3).
        axes: Two tangents and the outward normal of each, as rows, shape (k, 3, 3).
        gaps: Distances, negative inside, in m, shape (k,).
        friction: Coefficients of friction, shape (k,).
        restitution: Coefficients of restitution, shape (k,).
        jacobian: Jacobian of the points along their axes, shape (3 k, nv).
        drift: Velocities along the axes of what they touch, in m/s, shape (3 k,); None: at rest.
        spins: Friction against turning; None: nowhere.
    """

    numbers: Indices
    points: Vector
    axes: Vector
    gaps: Vector
    friction: Vector
    restitution: Vector
    jacobian: Vector
    drift: Vector | None = None
    spins: Spins | None = None

    def widened(self, span: slice, width: int) -> ContactPoints:
        """Return the points with a wider Jacobian, in which `span` holds their columns."""
        if self.jacobian.shape[1] == width:
            return self
        found = replace(self, jacobian=widened(self.jacobian, span, width))
        if self.spins is not None:
            jacobian = widened(self.spins.jacobian, span, width)
            found.spins = replace(self.spins, jacobian=jacobian)
        return found

    def records(self, body_a: Any, body_b: Any, impulses: Vector, period: float) -> Records:
        """Return the points as `CONTACT` records.

        Args:
            body_a: First body of each, an index into `Layout.names`.
            body_b: Second body of each.
            impulses: Impulses on the first body along the axes, in N s, shape (k, 3).
            period: Length of the step, in s.
        """
        records = np.zeros(len(self.gaps), CONTACT)
        records["body_a"], records["body_b"] = body_a, body_b
        records["point"], records["normal"] = self.points, self.axes[:, 2]
        records["force"] = np.einsum("kij,ki->kj", self.axes, impulses / period)
        records["depth"] = np.maximum(-self.gaps, 0.0)
        if self.spins is not None:
            rows, impulses = self.spins.points, self.spins.impulses
            records["torque"][rows] = np.einsum("kij,ki->kj", self.axes[rows], impulses / period)
        return records

    def bias_slopes(self, period: float) -> Vector:
        """Return the derivatives of the normal biases by the gaps, in 1/s, shape (k,)."""
        gaps = self.gaps
        returning = np.where(_RETURN * gaps > -_FASTEST_RETURN * period, _RETURN, 0.0)
        return np.where(gaps > 0, 1.0, returning) / period

    def bias(self, before: Vector, period: float) -> Vector:
        """Return the velocity bias along the axes, shape (3 k,).

        Args:
            before: Velocities before the step, shape (nv,).
            period: Length of the step, in s.
        """
        found = np.zeros(3 * len(self.gaps))
        found[2::3] = [
            gap / period if gap > 0 else max(_RETURN * gap / period, -_FASTEST_RETURN)
            for gap in self.gaps.tolist()
        ]
        if self.drift is not None:
            found -= self.drift
        if any(self.restitution.tolist()):
            drift = np.zeros(len(self.gaps)) if self.drift is None else self.drift[2::3]
            approach = self.jacobian[2::3] @ before - drift
            bounces = (self.restitution > 0) & (approach < -_BOUNCE)
            found[2::3] = np.where(bounces, self.restitution * approach - drift, found[2::3])
        return found


class ContactFinder:
    """Finds the contacts of a robot or object with static bodies."""

    def __init__(
        self,
        movable: MovableBody,
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
            if (surface := surface_of(static)) is not None
        ]
        self._up = next(
            (each.normal for _, each in self._surfaces if isinstance(each, Plane)),
            np.array([0.0, 0.0, 1.0]),
        )
        links = {name: i for i, name in enumerate(movable.model.links)}
        points: list[tuple[int, Vector, float, int, CollisionShape]] = []
        rims: list[tuple[int, Vector, float, int, CollisionShape, Vector]] = []
        for shape in movable.model.shapes if self._surfaces else ():
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
        self._arrange(points, rims)
        anchors = [*points, *(rim[:5] for rim in rims for _ in _THIRDS)]
        places = {id(shape): place for place, shape in enumerate(movable.model.shapes)}
        self._shapes = [places[id(row[4])] for row in anchors]
        self._drifts: dict[int, Vector] = {}
        self.hidden = False
        self.take_materials(movable, statics)

    def take_materials(self, movable: MovableBody, statics: Sequence[Static]) -> None:
        """Take over friction and restitution, and the heights of the ground."""
        shapes = [movable.model.shapes[place] for place in self._shapes]
        of_materials = np.array([(x.what.friction, x.what.restitution) for x in statics])
        of_shapes = np.array([(shape.friction, shape.restitution) for shape in shapes])
        first, second = of_materials.reshape(-1, 1, 2), of_shapes.reshape(1, -1, 2)
        self._spins = spins_of(
            np.array([turning_of(x.what) for x in statics]).reshape(-1, 1, 2),
            np.array([turning_of(shape) for shape in shapes]).reshape(1, -1, 2),
        )
        self._friction = np.minimum(first[:, :, 0], second[:, :, 0])
        self._restitution = first[:, :, 1] * second[:, :, 1]
        for number, (place, surface) in enumerate(self._surfaces):
            what = statics[place].what
            if isinstance(surface, Heights) and isinstance(what, HeightField):
                self._surfaces[number] = place, Heights(what)

    def move_surface(self, static: int, velocity: Vector) -> None:
        """Let the surface of a static body move along itself, in m/s, shape (3,)."""
        self._drifts.pop(static, None)
        if velocity.any():
            self._drifts[static] = velocity.copy()

    def _arrange(self, points: list[Any], rims: list[Any]) -> None:
        """Collect the points, then the rim centers, in arrays."""
        model, anchors, around = self._model, [*points, *rims], len(_THIRDS)
        self._poses = poses_of(self._data)
        moved = supports_of(model)
        joints = np.array([row[0] for row in anchors], np.intp)
        self._joints, self._first_rim = joints, len(points)
        # A point is a combination of its joint's axes plus the joint's origin.
        self._weights = np.zeros((len(anchors), 4 * len(self._poses)))
        for weights, (joint, center, *_) in zip(self._weights, anchors, strict=True):
            weights[4 * joint : 4 * joint + 4] = *center, 1.0
        self._rim_radii = np.array([row[2] for row in rims])
        self._rim_joints = joints[len(points) :]
        self._rim_moved = moved[self._rim_joints]
        self._rim_axes = np.array([row[5] for row in rims]).reshape(-1, 3, 3)
        spread = np.repeat(np.arange(len(anchors)), [1] * len(points) + [around] * len(rims))
        self._links = np.array([row[3] for row in anchors], np.intp)[spread]
        self._radii = np.array([row[2] for row in points] + [0.0] * (around * len(rims)))
        self._joint_of = joints[spread]
        self._moved = moved[joints[spread]]
        self._moved_along_axes = np.tile(self._moved, 3)
        self._rim_of = np.full(len(spread), -1)  # of the deepest points
        self._rim_of[len(points) :: around] = np.arange(len(rims))

    def __bool__(self) -> bool:
        """Return whether anything can ever touch."""
        return len(self._joints) > 0 and not self.hidden

    def __len__(self) -> int:
        """Return an upper bound on `ContactPoints.numbers`."""
        return self._friction.size

    def find(self, q: Vector, v: Vector, period: float) -> ContactPoints | None:
        """Return the points that touch or may touch within the next step, or None.

        Args:
            q: Positions, shape (nq,).
            v: Velocities that the robot would have without contacts, shape (nv,).
            period: Length of the step, in s.
        """
        motions = twists_of(pinocchio.computeJointJacobians(self._model, self._data, q))
        points = self._weights.dot(self._poses.reshape(-1, 3))
        if self._first_rim < len(points):
            points = np.concatenate([points[: self._first_rim], self._on_rims(points)])
        found = []
        for place, surface in self._surfaces:
            gaps, axes = surface.distances(points)
            gaps -= self._radii
            rows = self._near(surface, points, axes, gaps, motions, v, period)
            if not len(rows):
                continue
            gaps, normals = gaps.take(rows), axes.take(rows, 0)
            depths = self._radii.take(rows) + _HALF * np.minimum(gaps, _ZERO)
            touched = points.take(rows, 0) - depths[:, None] * normals[:, 2]
            jacobian = surface.twist_rows(touched, normals).reshape(-1, 6).dot(motions)
            jacobian *= self._moved_along_axes.take(rows, 0).reshape(jacobian.shape)
            numbers, spins = place * len(points) + rows, None
            if self._spins is not None:
                moved = self._moved.take(rows, 0)
                spins = Spins.of(self._spins[numbers], normals, motions, moved)
            found.append(
                ContactPoints(
                    numbers,
                    touched,
                    normals,
                    gaps,
                    self._friction.take(numbers),
                    self._restitution.take(numbers),
                    jacobian,
                    self._drift(place, normals, rows, motions, v, period),
                    spins,
                )
            )
        return _together(found) if found else None

    def _near(
        self,
        surface: Surface,
        points: Vector,
        axes: Vector,
        gaps: Vector,
        motions: Vector,
        v: Vector,
        period: float,
    ) -> Indices:
        """Return the points (n, 3) that touch a surface or may touch it within the next step."""
        speeds = surface.normal_rows(points, axes).dot(motions)
        speeds *= self._moved
        ahead = speeds.dot(v)
        ahead *= period
        ahead += gaps
        near: Indices = (np.minimum(gaps, ahead, out=ahead) < _NEAR).nonzero()[0]
        return near

    def _drift(
        self,
        static: int,
        axes: Vector,
        points: Indices,
        motions: Vector,
        v: Vector,
        period: float,
    ) -> Vector | None:
        """Return the velocities along the axes (k, 3, 3) that points stick to, shape (3 k,).

        Args:
            static: The surface, whose velocity it is.
            axes: Two tangents and the normal of each point.
            points: The points.
            motions: Twists for unit velocities, shape (6, nv).
            v: Velocities without contacts, shape (nv,).
            period: Length of the step, in s.
        """
        if not len(self._rim_radii) and not self._drifts:
            return None
        found: Vector = axes @ self._drifts.get(static, np.zeros(3))
        rims = self._rim_of.take(points)
        rolling = (rims >= 0).nonzero()[0]
        if len(rolling):
            speeds = self._rolling(rims.take(rolling), motions[3:] * v, period)
            found[rolling] += np.einsum("kij,kj->ki", axes.take(rolling, 0), speeds)
        found[:, 2] = 0.0
        return found.ravel()

    def anchors(self, found: ContactPoints, before: Vector) -> tuple[Indices, Vector]:
        """Return the joints that carry points, and centers that move with these, shape (k, 3).

        Args:
            found: Points from `find`.
            before: Velocities before the step, shape (nv,).

        Raises:
            SimulationError: If the velocities of the points after a step are not smooth.
        """
        numbers, points = np.divmod(found.numbers, len(self._links))
        radii, normals = self._radii[points], found.axes[:, 2]
        centers = found.points + (radii + 0.5 * np.minimum(found.gaps, 0.0))[:, None] * normals
        bounces = (found.restitution > 0) & (found.jacobian[2::3] @ before < -_BOUNCE)
        at_edges = np.zeros(len(points), np.bool_)
        for place, surface in self._surfaces:
            mine = numbers == place
            at_edges[mine] = surface.at_edges(centers[mine])
        for where, what in (
            (points >= self._first_rim, "a cylinder rolls along its rim; use spheres or capsules"),
            (bounces, "a contact bounces; use a restitution of 0"),
            (at_edges, "a point touches an edge of a height field"),
        ):
            if where.any():
                raise SimulationError(f"A step has no derivatives where {what}.")
        return self._joint_of[points], centers

    def bodies(self, numbers: Indices) -> tuple[Indices, Indices]:
        """Return the robot's links and the static bodies for `ContactPoints.numbers`."""
        statics, points = np.divmod(numbers, len(self._links))
        return self._links[points], statics

    def _rim_frames(self, rims: Indices | slice) -> tuple[Vector, Vector, Vector]:
        """Return how rims lie.

        Returns:
            Their axes, and the directions from their centers to their deepest points, shape (k, 3);
            the sines of the angles between axes and the ground's normal, 0 for flat ones, (k, 1).
        """
        up = self._up
        poses = self._poses[self._rim_joints[rims], :3].transpose(0, 2, 1)
        axes = poses @ self._rim_axes[rims]
        along = axes[:, :, 2]
        downward = (along @ up)[:, None] * along - up
        sines = np.sqrt(np.einsum("ij,ij->i", downward, downward))[:, None]
        sines[sines <= _FLAT] = 0.0
        beside = np.where(sines, downward / np.where(sines, sines, 1.0), axes[:, :, 0])
        return along, beside, sines

    def _on_rims(self, points: Vector) -> Vector:
        """Return three points on each rim, the deepest first, shape (3 rims, 3).

        Args:
            points: Centers of spheres and rims.
        """
        along, beside, _ = self._rim_frames(slice(None))
        around = _THIRDS @ np.stack([beside, cross_rows(along, beside)], axis=1)
        centers, radii = points[self._first_rim :, None], self._rim_radii[:, None, None]
        found: Vector = (centers + radii * around).reshape(-1, 3)
        return found

    def _rolling(self, rims: Indices, turns: Vector, period: float) -> Vector:
        """Return the velocities with which the deepest points of rims end a step if they stick.

        Where a rim rolls, the point that touches runs along it, so the velocity that friction has
        just stopped is not that of the next point, and friction would do work on it: Euler's disk
        would gain energy. If each point ends its step with half the difference, in the other
        direction, no work is done.

        Args:
            rims: The rims.
            turns: What each velocity adds to angular velocities, in rad/s, shape (3, nv).
            period: Length of the step, in s.

        Returns:
            The velocities, in m/s, shape (k, 3).
        """
        up, (along, beside, sines) = self._up, self._rim_frames(rims)
        turns = self._rim_moved[rims].dot(turns.T)
        tilting = cross_rows(turns, along)
        pace = (tilting @ up)[:, None] * along + (along @ up)[:, None] * tilting
        pace -= np.einsum("ij,ij->i", beside, pace)[:, None] * beside
        run = period * (pace / np.where(sines, sines, 1.0) - cross_rows(turns, beside))
        far = np.einsum("ij,ij->i", run, run) > _FARTHEST_RUN**2
        run[far | (sines[:, 0] == 0)] = 0.0
        found: Vector = -0.5 * self._rim_radii[rims, None] * cross_rows(turns, run)
        return found


def supports_of(model: Any) -> Vector:
    """Return a matrix with 1 where a velocity (column) moves a joint (row), otherwise 0."""
    moved = np.zeros((model.njoints, model.nv))
    for joint in range(1, model.njoints):
        for each in (each for each in model.supports[joint] if each > 0):
            first = model.idx_vs[each]
            moved[joint, first : first + model.nvs[each]] = 1.0
    return moved


def poses_of(data: Any) -> Vector:
    """Return a view of the joints' axes and positions in Pinocchio's memory, shape (n, 4, 3).

    It changes with each algorithm that places joints, and is valid as long as the data exists.
    """
    first, second = data.oMi[0].rotation, data.oMi[len(data.oMi) > 1].rotation
    pace = second.__array_interface__["data"][0] - first.__array_interface__["data"][0]
    strides = (pace, 3 * first.itemsize, first.itemsize)
    return np.lib.stride_tricks.as_strided(first, (len(data.oMi), 4, 3), strides)


def turning_of(material: CollisionShape | Ground | Stairs | HeightField) -> tuple[float, float]:
    """Return the rolling and the torsional friction of a material, in m."""
    return material.rolling_friction, material.torsional_friction


def spins_of(first: Vector, second: Vector) -> Vector | None:
    """Return the bounds of all pairs of materials as in `Spins`, shape (pairs, 2); None: all 0."""
    found = np.maximum(first, second).reshape(-1, 2)
    return found if found.any() else None


def together(points: Sequence[ContactPoints]) -> Spins | None:
    """Return the friction against turning of points that are combined in this order."""
    first, numbers, found = 0, [], []
    for each in points:
        if each.spins is not None:
            numbers.append(first + each.spins.points)
            found.append(each.spins)
        first += len(each.gaps)
    if not found:
        return None
    names = ("bounds", "jacobian", "drift", "impulses")
    rest = (np.concatenate([getattr(spins, name) for spins in found]) for name in names)
    return Spins(np.concatenate(numbers), *rest)


def joined(arrays: Sequence[Any]) -> Any:
    """Concatenate arrays."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def widened(jacobian: Vector, span: slice, width: int) -> Vector:
    """Return a Jacobian with zeros for velocities outside a span."""
    if jacobian.shape[1] == width:
        return jacobian
    wide = np.zeros((len(jacobian), width))
    wide[:, span] = jacobian
    return wide


def _together(found: list[ContactPoints]) -> ContactPoints:
    """Return the points of several surfaces combined."""
    if len(found) == 1:
        return found[0]
    *names, _, _ = ContactPoints.__slots__
    whole: dict[str, Any] = {
        name: np.concatenate([getattr(each, name) for each in found]) for name in names
    }
    points = ContactPoints(**whole)
    if found[0].drift is not None:
        points.drift = np.concatenate([each.drift for each in found if each.drift is not None])
    points.spins = together(found)
    return points


def _points(shape: CollisionShape) -> tuple[Vector, float]:
    """Return the centers of a shape's spheres and their radius; a radius of 0 means points."""
    if shape.kind == "box":
        return _CORNERS * np.array(shape.size), 0.0
    if shape.kind == "sphere":
        return np.zeros((1, 3)), shape.size[0]
    ends = np.zeros((2, 3))
    ends[:, 2] = -0.5 * shape.size[1], 0.5 * shape.size[1]
    return ends, shape.size[0]
