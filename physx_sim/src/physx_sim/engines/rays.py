"""Ray casts on shapes, planes, height fields, and meshes: the same on every engine."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from physx_core.rotations import to_matrix_rows
from physx_core.typing import Index, Records, Vector
from physx_sim import RAY_HIT, Ground, HeightField, Stairs
from physx_sim.engines.models.meshes import read_triangles
from physx_sim.engines.models.parts import Parts
from physx_sim.engines.models.shapes import CollisionShape, steps_of

_KINDS = ("sphere", "capsule", "cylinder", "box", "mesh")
_CYLINDER, _BOX, _MESH = 2, 3, 4
_TINY = 1e-300
"""Replaces a 0 by which something is divided."""

Mask = NDArray[np.bool_]


class Caster:
    """The shapes of a world, prepared for ray casts. A ray hits what it enters from outside.

    Args:
        parts: The world. What can touch nothing in it has no shapes.
    """

    def __init__(self, parts: Parts) -> None:
        found: list[tuple[int, CollisionShape]] = []
        self._planes: list[tuple[int, Vector, float]] = []
        self._heights: list[tuple[int, _Heights]] = []
        first = 0
        for movable in parts.movables:
            links = {name: place for place, name in enumerate(movable.model.links)}
            for shape in movable.model.shapes:
                found.append((first + links.get(shape.body, 0), shape))
            first += len(links)
        for body, static in enumerate(parts.statics, first):
            what = static.what
            if isinstance(what, CollisionShape):
                found.append((body, what))
            elif isinstance(what, HeightField):
                self._heights.append((body, _Heights(what)))
            else:
                normal = np.array(what.normal if isinstance(what, Ground) else (0.0, 0.0, 1.0))
                height = what.height if isinstance(what, Ground) else 0.0
                self._planes.append((body, normal, float(height)))
                steps = steps_of(what) if isinstance(what, Stairs) else ()
                found += ((body, step) for step in steps)
        found.sort(key=lambda each: _KINDS.index(each[1].kind))
        self._shapes = [shape for _, shape in found]
        self.bodies = np.array([body for body, _ in found], np.intp)
        self._turns = np.array([shape.rotation for shape in self._shapes]).reshape(-1, 3, 3)
        self._places = np.array([shape.position for shape in self._shapes]).reshape(-1, 3)
        kinds = [_KINDS.index(shape.kind) for shape in self._shapes]
        self._ends = np.searchsorted(kinds, [_BOX, _MESH], side="left").tolist()
        self._sizes = np.zeros((len(found), 3))  # half the edges of a box; radius, half the length
        for row, shape in zip(self._sizes, self._shapes, strict=True):
            row[: len(shape.size)] = shape.size
            row *= 0.5 if shape.kind == "box" else (1.0, 0.5, 1.0)
        self._flat = np.array(kinds) == _CYLINDER
        self._meshes = {
            place: read_triangles(shape.mesh, shape.size)
            for place, shape in enumerate(self._shapes)
            if shape.mesh is not None
        }
        self._reaches = np.array([self._reach(place) for place in range(len(found))])

    def cast(
        self, begins: Vector, ends: Vector, poses: Vector, ignored: Collection[int]
    ) -> Records:
        """Return the first hit of each ray as an array of `RAY_HIT` records.

        Args:
            begins: Start points, shape (n, 3), in m, in the world frame.
            ends: End points, in the same form.
            poses: Poses of all bodies, static ones included, shape (bodies, 7).
            ignored: Bodies that rays pass, as indices into `Layout.names`.
        """
        ways, best, normals = ends - begins, np.full(len(begins), np.inf), np.zeros(begins.shape)
        touched = np.full(len(begins), -1)
        if len(self._shapes) and len(begins):
            turns = to_matrix_rows(poses[:, 3:])[self.bodies]
            places = (turns @ self._places[..., None])[..., 0] + poses[self.bodies, :3]
            turns = turns @ self._turns
            shapes, near = self._near(places, begins, ways, ignored)
            turned = turns[shapes]
            starts = ((begins[near] - places[shapes])[:, None] @ turned)[:, 0]
            along = (ways[near][:, None] @ turned)[:, 0]
            fractions = self._fractions(shapes, starts, along)
            entered = (fractions <= 1.0).nonzero()[0]
            # Of the pairs of a ray, the nearest comes last and stays.
            entered = entered[fractions[entered].argsort(kind="stable")[::-1]]
            first = touched.copy()
            first[near[entered]] = entered
            rays = (first >= 0).nonzero()[0]
            chosen = first[rays]
            best[rays], which = fractions[chosen], shapes[chosen]
            local = self._normals(which, starts[chosen], along[chosen], best[rays])
            normals[rays] = (turns[which] @ local[..., None])[..., 0]
            touched[rays] = self.bodies[which]
        for body, normal, height in self._planes:
            if body not in ignored:
                above, speed = begins @ normal - height, ways @ normal
                with np.errstate(divide="ignore", invalid="ignore"):
                    t = np.where((above >= 0) & (speed < 0), above / -speed, np.inf)
                closer = t < best
                best[closer], touched[closer], normals[closer] = t[closer], body, normal
        for body, field in self._heights:
            if body not in ignored:
                t, upward = field.cast(begins, ways)
                closer = t < best
                best[closer], touched[closer], normals[closer] = t[closer], body, upward[closer]
        hit = best <= 1.0
        records, best = np.zeros(len(begins), RAY_HIT), np.where(hit, best, 0.0)
        records["hit"], records["body"] = hit, np.where(hit, touched, -1)
        records["fraction"], records["normal"] = best, hit[:, None] * normals
        records["point"] = hit[:, None] * (begins + best[:, None] * ways)
        return records

    def _reach(self, place: int) -> float:
        """Return the radius of a sphere around the frame of a shape that contains it."""
        shape, size = self._shapes[place], self._sizes[place]
        if shape.kind == "box":
            return float(np.linalg.norm(size))
        if shape.kind == "mesh":
            return float(np.linalg.norm(self._meshes[place], axis=-1).max(initial=0.0))
        return float(size[0] + size[1])

    def _near(
        self, places: Vector, begins: Vector, ways: Vector, ignored: Collection[int]
    ) -> tuple[Index, Index]:
        """Return pairs of a shape and a ray that comes near it, ordered by the shapes."""
        # Squared distances by products of matrices, from a point near the rays: an array of vectors
        # takes several times as long. What this costs in accuracy is added to the reaches.
        places, begins = places - begins[0], begins - begins[0]
        apart, lengths = _dot(places, places)[:, None] + _dot(begins, begins), _dot(ways, ways)
        lost = 1e-14 * (apart.max() + lengths.max())
        along = places @ ways.T - _dot(begins, ways)
        share = along / np.maximum(lengths, _TINY)
        np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
        apart -= 2.0 * (places @ begins.T) + share * (2.0 * along - share * lengths)
        reaches = (self._reaches * (1 + 1e-9) + 1e-12) ** 2 + lost
        if ignored:
            reaches[np.isin(self.bodies, list(ignored))] = -np.inf
        close = apart <= reaches[:, None]
        shapes, rays = close.nonzero()
        return shapes, rays

    def _fractions(self, shapes: Index, starts: Vector, along: Vector) -> Vector:
        """Return where rays enter shapes, in the shapes' frames, shape (pairs,); inf: nowhere."""
        found, size = np.full(len(shapes), np.inf), self._sizes[shapes]
        boxes, meshes = np.searchsorted(shapes, self._ends).tolist()
        if boxes:
            rows = slice(boxes)
            flat = self._flat[shapes[rows]]
            radii, halves = size[rows, 0], size[rows, 1]
            found[rows] = _enter_round(starts[rows], along[rows], radii, halves, flat)
        if boxes < meshes:
            rows = slice(boxes, meshes)
            found[rows] = _enter_box(starts[rows], along[rows], size[rows])
        for place in set(shapes[meshes:].tolist()):
            pairs = (shapes == place).nonzero()[0]
            found[pairs] = _enter_mesh(starts[pairs], along[pairs], self._meshes[place])[0]
        return found

    def _normals(self, which: Index, starts: Vector, along: Vector, fractions: Vector) -> Vector:
        """Return the normals (n, 3) of shapes where rays enter them, in their frames."""
        points, size = starts + fractions[:, None] * along, self._sizes[which]
        found, (boxes, meshes) = points.copy(), self._ends
        if boxes:
            found[:, 2] -= np.minimum(np.maximum(points[:, 2], -size[:, 1]), size[:, 1])
            depth = size[:, 0] - np.hypot(points[:, 0], points[:, 1])
            caps = self._flat[which] & (size[:, 1] - np.abs(points[:, 2]) < depth)
            found[caps] = np.sign(points[caps, 2])[:, None] * (0.0, 0.0, 1.0)
        rows = ((which >= boxes) & (which < meshes)).nonzero()[0]
        if len(rows):
            axis = np.abs(points[rows] / size[rows]).argmax(axis=1)
            found[rows] = 0.0
            found[rows, axis] = np.sign(points[rows, axis])
        for row in (which >= meshes).nonzero()[0].tolist():
            mesh = self._meshes[int(which[row])]
            found[row] = _enter_mesh(starts[row, None], along[row, None], mesh)[1][0]
        found /= np.maximum(np.sqrt(_dot(found, found)), _TINY)[:, None]
        return found


def _dot(one: Vector, other: Vector) -> Vector:
    """Return the dot products of rows."""
    found: Vector = np.einsum("...i,...i->...", one, other)
    return found


def _enter_box(o: Vector, d: Vector, half: Vector) -> Vector:
    d = np.where(d == 0, _TINY, d)
    with np.errstate(over="ignore", invalid="ignore"):
        one, other = (-half - o) / d, (half - o) / d
        near = np.minimum(one, other).max(axis=-1)
        far = np.maximum(one, other).min(axis=-1)
    return np.where((near <= far) & (near >= 0), near, np.inf)


def _enter(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return the first root t of a t² + 2 b t + c = 0 where it falls below 0; inf: none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(c >= 0, (-b - np.sqrt(b * b - a * c)) / a, np.nan)
    return np.where(t >= 0, t, np.inf)


def _enter_ball(o: Vector, d: Vector, radius: Vector) -> Vector:
    return _enter(_dot(d, d), _dot(o, d), _dot(o, o) - radius**2)


def _enter_round(o: Vector, d: Vector, radius: Vector, half: Vector, flat: Mask) -> Vector:
    """Return where rays enter capsules, and cylinders where `flat`, around the z axis."""
    with np.errstate(invalid="ignore", divide="ignore"):
        side = _enter_ball(o[:, :2], d[:, :2], radius)
        found = np.where(np.abs(o[:, 2] + side * d[:, 2]) <= half, side, np.inf)
        for end in (-1.0, 1.0):
            away, speed = end * o[:, 2] - half, end * d[:, 2]
            moved = o.copy()
            moved[:, 2] = away
            t = _enter_ball(moved, np.column_stack([d[:, :2], speed]), radius)
            valid = ~flat & (away + t * speed >= 0)
            if flat.any():
                cap = np.where((away >= 0) & (speed < 0), -away / speed, np.inf)
                reached = o[:, :2] + cap[:, None] * d[:, :2]
                valid |= flat & (_dot(reached, reached) <= radius**2)
                t = np.where(flat, cap, t)
            found = np.minimum(found, np.where(valid, t, np.inf))
    return found


def _enter_mesh(o: Vector, d: Vector, triangles: Vector) -> tuple[Vector, Vector]:
    """Return where rays (n, 3) enter the front of triangles (m, 3, 3), and the normals there."""
    found, normals = np.full(len(o), np.inf), np.zeros((len(o), 3))
    one, first, second = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2]
    second = second - one
    across = np.cross(first, second)
    for ray in range(len(o)):  # T. Möller and B. Trumbore, 1997
        way, arm = d[ray], o[ray] - one
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = -1.0 / (across @ way)
            turned = np.cross(arm, way)
            u = (second * turned).sum(axis=1) * scale
            v = -(first * turned).sum(axis=1) * scale
            t = (across * arm).sum(axis=1) * scale
            valid = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (t >= 0) & (scale > 0)
        if valid.any():
            place = int(np.where(valid, t, np.inf).argmin())
            found[ray] = t[place]
            normals[ray] = across[place] / np.linalg.norm(across[place])
    return found, normals


class _Heights:
    """A height field, whose cells are crossed one after the other."""

    def __init__(self, field: HeightField) -> None:
        self._z, self._spacing = field.heights, np.array(field.spacing)
        self._corner, self._last = np.array(field.corner()), np.array(field.heights.shape) - 1

    def cast(self, begins: Vector, ways: Vector) -> tuple[Vector, Vector]:
        """Return where rays pass the surface from above, shape (n,), and the normals (n, 3)."""
        o, d = (begins[:, :2] - self._corner) / self._spacing, ways[:, :2] / self._spacing
        cuts = [np.zeros((len(o), 1)), np.ones((len(o), 1))]
        for axis in (0, 1):
            lines = self._crossed(o[:, axis], d[:, axis], int(self._last[axis]))
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (lines - o[:, axis, None]) / d[:, axis, None]
            cuts.append(np.where((t > 0) & (t < 1), t, 1.0))
        t = np.sort(np.concatenate(cuts, axis=1), axis=1)
        middle = 0.5 * (t[:, 1:] + t[:, :-1])[..., None]
        spots = o[:, None] + middle * d[:, None]
        inside = ((spots >= 0) & (spots <= self._last)).all(axis=2) & (t[:, 1:] > t[:, :-1])
        inside[:, 0] |= ((o >= 0) & (o <= self._last)).all(axis=1) & ~d.any(axis=1)
        cells = np.clip(np.floor(spots), 0, self._last - 1).astype(np.intp)
        i, j = cells[..., 0], cells[..., 1]
        z, best, slope = self._z, np.full(len(o), np.inf), np.zeros((len(o), 2))
        low, x, y, high = z[i, j], z[i + 1, j], z[i, j + 1], z[i + 1, j + 1]
        for below, a, b in ((True, x - low, high - x), (False, high - y, y - low)):
            height, speed = begins[:, 2, None] - low, ways[:, 2, None]
            u, v = o[:, 0, None] - i, o[:, 1, None] - j
            above = height - a * u - b * v  # at the start of the ray, over this triangle's plane
            fall = a * d[:, 0, None] + b * d[:, 1, None] - speed
            with np.errstate(divide="ignore", invalid="ignore"):
                at = above / fall
                left = u + at * d[:, 0, None] - (v + at * d[:, 1, None])
                edge = 1e-9
                own = (left >= -edge) if below else (left <= edge)
                on = inside & own & (fall > 0) & (at >= t[:, :-1] - edge) & (at <= t[:, 1:] + edge)
            at = np.where(on & (at >= 0), at, np.inf)
            first = at.argmin(axis=1)
            rays = np.arange(len(o))
            closer = at[rays, first] < best
            best[closer] = at[rays, first][closer]
            chosen = np.stack([a[rays, first], b[rays, first]], axis=1)
            slope[closer] = chosen[closer]
        normals = np.column_stack([-slope / self._spacing, np.ones(len(o))])
        return best, normals / np.linalg.norm(normals, axis=1)[:, None]

    def _crossed(self, o: Vector, d: Vector, last: int) -> Vector:
        """Return the grid lines between the lowest and the highest end of rays along an axis."""
        ends = np.concatenate([o, o + d])
        low = int(np.clip(np.ceil(ends.min(initial=0.0)), 0, last))
        high = int(np.clip(np.floor(ends.max(initial=0.0)), 0, last))
        lines: NDArray[np.float64] = np.arange(low, high + 1, dtype=np.float64)
        return lines
