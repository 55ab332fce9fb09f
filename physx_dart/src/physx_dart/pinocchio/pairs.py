"""Contacts between shapes of bodies, links, and static objects, found by coal.

coal finds the patch in which two shapes touch: the points of faces, edges, and corners that lie in
one plane.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
from numpy.typing import NDArray

from physx_core.rotations import cross_rows, to_matrix
from physx_core.typing import Index, Vector
from physx_dart.pinocchio.contacts import (
    MARGIN,
    ContactPoints,
    Spins,
    poses_of,
    spins_of,
    supports_of,
    turning_of,
)
from physx_dart.pinocchio.robot import PinocchioRobot
from physx_dart.pinocchio.surfaces import axes_of, twist_rows
from physx_sim import Stairs
from physx_sim.engines import CollisionShape, Parts, steps_of
from physx_sim.errors import FeatureNotSupportedError

_TOLERANCE = 1e-4
"""Distance, in m, from the plane of a patch up to which a point belongs to it."""

_NOWHERE = -1e9
"""Radius of the bounding sphere of a hidden shape, in m: nothing is near it."""


@dataclass(eq=False, slots=True)
class _Solid:
    """A collision shape: index of its robot (None: static), joint, link, body, and pose there."""

    owner: int | None
    joint: int
    link: int
    body: int
    shape: CollisionShape
    rotation: Vector
    position: Vector


@dataclass(eq=False, slots=True)
class PairPoints:
    """Points where shapes touch, or may touch within the next step.

    Attributes:
        pairs: The pair of shapes of each, shape (k,).
        bodies: Its two bodies, as indices into `Layout.names`, shape (k, 2).
        robots: Indices of all robots that touch.
        contacts: The points; the Jacobian has a column for each velocity of all robots.
    """

    pairs: NDArray[np.intp]
    bodies: NDArray[np.intp]
    robots: set[int]
    contacts: ContactPoints


class PairFinder:
    """Finds contacts among the shapes of robots and objects, and with static shapes."""

    def __init__(
        self, parts: Parts, robots: Sequence[PinocchioRobot], features: Sequence[str]
    ) -> None:
        """Prepare all pairs that may touch."""
        self._robots, self._parts = robots, parts
        solids = [*self._moving(), *self._static()]
        self._pairs = list(self._possible(solids))
        if any(solids[place].shape.kind == "mesh" for pair in self._pairs for place in pair):
            advice = 'Use Robot(collisions="boxes") or "capsules", or a box as an object.'
            raise FeatureNotSupportedError("pinocchio", "mesh_contacts", features, advice)
        self._solids = solids
        self._poses = [poses_of(robot.data) for robot in robots]
        self._supports = [supports_of(robot.model_in_motion) for robot in robots]
        ends = [1, *(1 + np.cumsum([len(poses) for poses in self._poses])).tolist()]
        self._rows = [slice(*pair) for pair in itertools.pairwise(ends)]
        widths = np.cumsum([0, *(robot.nv for robot in robots)]).tolist()
        self.columns = [slice(*pair) for pair in itertools.pairwise(widths)]
        # Poses and twists of all joints; the first row is for static bodies.
        self._turns, self._places = np.zeros((ends[-1], 3, 3)), np.zeros((ends[-1], 3))
        self._twists, self._turns[0] = np.zeros((ends[-1], 6)), np.eye(3)
        joints = [0 if s.owner is None else ends[s.owner] + s.joint for s in solids]
        self._joints = np.array(joints, np.intp)
        self._rotations = np.array([solid.rotation for solid in solids]).reshape(-1, 3, 3)
        self._positions = np.array([solid.position for solid in solids]).reshape(-1, 3, 1)
        self._radii = np.array([_radius(solid.shape) for solid in solids])
        self._first, self._second = np.array(self._pairs, np.intp).reshape(-1, 2).T
        self._note_spins()
        self._transforms = [coal.Transform3s() for _ in solids]
        shapes = [_geometry(solid.shape) for solid in solids]
        self._queries = [
            (coal.ComputeCollision(a, b), coal.ComputeContactPatch(a, b))
            for a, b in ((shapes[i], shapes[j]) for i, j in self._pairs)
        ]
        self._geometries = shapes  # the queries do not keep them alive
        self._request, self._patch_request = coal.CollisionRequest(), coal.ContactPatchRequest()
        self._paces = np.zeros(len(solids))
        self._moved: dict[int, tuple[Vector, Vector, Vector]] = {}
        self._request.enable_contact, self._request.num_max_contacts = True, 1
        self._patch_request.setPatchTolerance(_TOLERANCE)

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self._pairs)

    def _moving(self) -> Iterator[_Solid]:
        first = 0
        for owner, (movable, robot) in enumerate(
            zip(self._parts.movables, self._robots, strict=True)
        ):
            links = {name: i for i, name in enumerate(movable.model.links)}
            for shape in movable.model.shapes:
                link = links.get(shape.body, 0)
                frame = robot.model_in_motion.frames[robot.frames[link]]
                turn, place = frame.placement.rotation, frame.placement.translation
                pose = turn @ shape.rotation, turn @ shape.position + place
                yield _Solid(owner, frame.parentJoint, link, first + link, shape, *pose)
            first += len(movable.model.links)
        self.statics = first

    def _static(self) -> Iterator[_Solid]:
        for place, static in enumerate(self._parts.statics):
            what, body = static.what, self.statics + place
            if isinstance(what, Stairs):
                for box in steps_of(what):
                    yield _Solid(None, 0, 0, body, box, box.rotation, box.position)
            elif isinstance(what, CollisionShape):
                turn = to_matrix(static.orientation)
                yield _Solid(None, 0, 0, body, what, turn, np.array(static.position))

    def take_materials(self, parts: Parts) -> None:
        """Take over friction and restitution from the parts of the world."""
        self._parts = parts
        found = [*self._moving(), *self._static()]
        for solid, changed in zip(self._solids, found, strict=True):
            solid.shape = changed.shape
        self._note_spins()

    def _note_spins(self) -> None:
        """Note which pairs resist turning."""
        turning = np.array([turning_of(solid.shape) for solid in self._solids]).reshape(-1, 2)
        self._spins = spins_of(turning[self._first], turning[self._second])

    def hide(self, bodies: Sequence[int]) -> None:
        """Let only bodies that are not among these touch."""
        for place, solid in enumerate(self._solids):
            hidden = solid.body in bodies
            self._radii[place] = _NOWHERE if hidden else _radius(solid.shape)

    def place_static(self, static: int, pose: Vector, velocity: Vector, surface: Vector) -> None:
        """Place a static body and prescribe its motion, as in `RobotSimulation.place_static`."""
        body, turn, center = self.statics + static, to_matrix(pose[3:]), pose[:3].copy()
        self._moved.pop(body, None)
        if velocity.any() or surface.any():
            self._moved[body] = center, velocity.copy(), turn @ surface
        for place, solid in enumerate(self._solids):
            if solid.body == body and not isinstance(self._parts.statics[static].what, Stairs):
                self._rotations[place], self._positions[place, :, 0] = turn, center
                self._paces[place] = np.linalg.norm(velocity[:3]) + (
                    np.linalg.norm(velocity[3:]) * _radius(solid.shape)
                )

    def _drift(self, bodies: Sequence[int], points: Vector, axes: Vector) -> Vector:
        """Return the velocities of static bodies along the axes of contact points, shape (3 k,).

        Args:
            bodies: The second body of each point.
            points: The points, shape (k, 3).
            axes: Two tangents and the normal of each, shape (k, 3, 3).
        """
        found = np.zeros((len(bodies), 3))
        for place, (body, point) in enumerate(zip(bodies, points, strict=True)):
            if body in self._moved:
                center, velocity, surface = self._moved[body]
                along = axes[place] @ surface
                along[2] = 0.0
                arm = cross_rows(velocity[3:], point - center)
                found[place] = along + axes[place] @ (velocity[:3] + arm)
        return found.ravel()

    def _let_turn(self, spins: Spins | None, pairs: Index, axes: Vector) -> None:
        """Take over how static bodies turn, in friction against it."""
        if spins is None:
            return
        for place, point in enumerate(spins.points.tolist()):
            body = self._solids[self._pairs[pairs[point]][1]].body
            if body in self._moved:
                spins.drift[3 * place : 3 * place + 3] = axes[point] @ self._moved[body][1][3:]

    def _possible(self, solids: Sequence[_Solid]) -> Iterator[tuple[int, int]]:
        """Yield the pairs of shapes that may touch: those that can move relative to each other."""
        contacts, movables = self._parts.world.contacts, self._parts.movables
        moves = [solid.owner is not None and movables[solid.owner].moves for solid in solids]
        for (i, a), (j, b) in itertools.combinations(enumerate(solids), 2):
            wanted = contacts == "all" or (contacts == "static" and moves[i] != moves[j])
            if a.owner is None or not wanted:
                continue
            if a.joint == 0 and (b.owner is None or b.joint == 0):
                continue
            if a.owner == b.owner:
                parents = self._robots[a.owner].model_in_motion.parents
                near = (
                    a.joint == b.joint or parents[a.joint] == b.joint or parents[b.joint] == a.joint
                )
                if near:
                    continue
                if not movables[a.owner].self_collisions:
                    continue
            yield i, j

    def find(self, velocities: Sequence[Vector], period: float) -> PairPoints | None:
        """Return the points that touch or may touch within the next step, or None.

        Args:
            velocities: Velocities that each robot would have without contacts.
            period: Length of the step, in s.
        """
        self._move(velocities)
        turns, twists = self._turns[self._joints], self._twists[self._joints]
        centers = (turns @ self._positions)[:, :, 0] + self._places[self._joints]
        speeds = _lengths(twists[:, :3] + cross_rows(twists[:, 3:], centers))
        speeds += self._paces
        reach = self._radii + period * (speeds + self._radii * _lengths(twists[:, 3:]))
        first, second = self._first, self._second
        apart = _lengths(centers[first] - centers[second])
        near = (apart < reach[first] + reach[second] + MARGIN).nonzero()[0].tolist()
        if not near:
            return None
        rotations, placed = turns @ self._rotations, set[int]()
        found: list[tuple[int, Vector, Vector, float]] = []
        margins = MARGIN + reach - self._radii
        for pair in near:
            i, j = self._pairs[pair]
            for solid in {i, j} - placed:
                self._transforms[solid].setRotation(rotations[solid])
                self._transforms[solid].setTranslation(centers[solid])
                placed.add(solid)
            found += self._touch(pair, float(margins[i] + margins[j]))
        return self._together(found, velocities, period) if found else None

    def _move(self, velocities: Sequence[Vector]) -> None:
        """Update poses and twists of all joints."""
        self._motions: list[Vector] = []
        for robot, velocity, poses, supports, rows in zip(
            self._robots, velocities, self._poses, self._supports, self._rows, strict=True
        ):
            motions = robot.place_joints()
            self._turns[rows], self._places[rows] = poses[:, :3].transpose(0, 2, 1), poses[:, 3]
            self._twists[rows] = (supports * velocity) @ motions.T
            self._motions.append(motions)

    def _touch(self, pair: int, margin: float) -> list[tuple[int, Vector, Vector, float]]:
        """Return the pair, point, normal from second to first shape, and gap of each point."""
        i, j = self._pairs[pair]
        poses, (collide, patch_of) = (self._transforms[i], self._transforms[j]), self._queries[pair]
        self._request.security_margin = margin
        result, patches = coal.CollisionResult(), coal.ContactPatchResult()
        if not collide(*poses, self._request, result):
            return []
        contact = result.getContact(0)
        normal, gap = -contact.normal, contact.penetration_depth
        patch_of(*poses, result, self._patch_request, patches)
        points = [contact.pos]
        if patches.numContactPatches():
            patch = patches.getContactPatch(0)
            points = [patch.getPoint(k) for k in range(patch.size())] or points
        return [(pair, point, normal, gap) for point in points]

    def _together(
        self, found: list[tuple[int, Vector, Vector, float]], velocities: Any, period: float
    ) -> PairPoints | None:
        """Return the points that touch within the step, with their Jacobian."""
        pairs = np.array([each[0] for each in found], np.intp)
        points = np.array([each[1] for each in found])
        axes = axes_of(np.array([each[2] for each in found]))
        gaps = np.array([each[3] for each in found])
        frames = twist_rows(points, axes)
        jacobian = np.zeros((3 * len(pairs), self.columns[-1].stop))
        shares = []
        sides = (self._first[pairs], 1.0), (self._second[pairs], -1.0)
        for motions, supports, rows, columns in zip(
            self._motions, self._supports, self._rows, self.columns, strict=True
        ):
            moved = np.zeros((len(pairs), supports.shape[1]))
            for solids, sign in sides:
                joints = self._joints[solids] - rows.start
                own = (joints >= 0) & (joints < len(supports))
                moved[own] += sign * supports[joints[own]]
            shares.append(moved)
            if moved.any():
                jacobian[:, columns] = frames.reshape(-1, 6) @ motions * np.repeat(moved, 3, axis=0)
        drift = None
        if self._moved:
            touched = [self._solids[self._pairs[pair][1]].body for pair in pairs]
            drift = self._drift(touched, points, axes)
        speeds = jacobian[2::3] @ np.concatenate(velocities)
        ahead = gaps + period * (speeds if drift is None else speeds - drift[2::3])
        close = (np.minimum(gaps, ahead) < MARGIN).nonzero()[0]
        if not len(close):
            return None
        pairs = pairs[close]
        spins = None
        if self._spins is not None:
            motions, moved = np.concatenate(self._motions, 1), np.concatenate(shares, 1)[close]
            spins = Spins.of(self._spins[pairs], axes[close], motions, moved)
            self._let_turn(spins, pairs, axes[close])
        places = (self._pairs[pair] for pair in pairs)
        touching = [(self._solids[i], self._solids[j]) for i, j in places]
        contacts = ContactPoints(
            pairs,
            points[close],
            axes[close],
            gaps[close],
            np.array([min(a.shape.friction, b.shape.friction) for a, b in touching]),
            np.array([a.shape.restitution * b.shape.restitution for a, b in touching]),
            jacobian.reshape(len(gaps), 3, -1)[close].reshape(3 * len(close), -1),
            None if drift is None else drift.reshape(-1, 3)[close].ravel(),
            spins,
        )
        owners = {
            solid.owner
            for both in touching
            for solid in both
            if solid.owner is not None and self._parts.movables[solid.owner].moves
        }
        bodies = np.array([(a.body, b.body) for a, b in touching], np.intp)
        return PairPoints(pairs, bodies, owners, contacts)


def _lengths(vectors: Vector) -> Vector:
    """Return the norms of rows."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def _radius(shape: CollisionShape) -> float:
    """Return the radius of a shape's bounding sphere, in m."""
    if shape.kind in ("box", "mesh"):
        return 0.5 * math.hypot(*shape.size)
    if shape.kind == "sphere":
        return shape.size[0]
    radius, length = shape.size
    return radius + 0.5 * length if shape.kind == "capsule" else math.hypot(radius, 0.5 * length)


def _geometry(shape: CollisionShape) -> Any:
    """Return a shape for coal, or None for a mesh, which touches nothing."""
    if shape.kind == "mesh":
        return None
    kinds = {"box": coal.Box, "sphere": coal.Sphere, "capsule": coal.Capsule}
    return kinds.get(shape.kind, coal.Cylinder)(*map(float, shape.size))
