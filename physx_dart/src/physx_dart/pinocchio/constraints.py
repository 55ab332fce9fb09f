"""Constraints of robots and objects in a step, solved together where they touch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from physx_core.typing import Index, Vector
from physx_dart.pinocchio.contact_problem import unit
from physx_dart.pinocchio.contacts import ContactPoints, Indices, Spins, joined, together
from physx_dart.pinocchio.limits import JointConstraints, solve
from physx_dart.pinocchio.solver import ImpulseSolver

_REACH = 1.0
"""Margin, in rad/s or m/s, within which a limit is included while there are contacts."""
_MISSED = 1e-9
"""Excess of a velocity over its bound at which a joint counts as outside its limits."""


class Warmth:
    """Impulses from a robot's last step, used to warm-start the next one.

    Args:
        points: Upper bound on `ContactPoints.numbers`.
        rows: Number of constraint rows of its joints.
    """

    def __init__(self, points: int, rows: int) -> None:
        self.points, self.rows = np.zeros((points, 3)), np.zeros(rows)

    def clear_warm_start(self) -> None:
        """Start with no impulses."""
        self.points.fill(0.0)
        self.rows.fill(0.0)


@dataclass(eq=False, slots=True)
class Solved:
    """What a step solved: impulses along rows of contact points, joints, ties, and turning points.

    Attributes:
        parts: Constraints of the robots; their velocities, one after the other, are the columns.
        inverse: Inverse of their mass matrix, shape (nv, nv).
        along: Jacobian of the rows, shape (n, nv).
        spread: Velocities for unit impulses, shape (nv, n).
        response: Velocities along the rows for unit impulses, shape (n, n).
        free: Velocities along the rows without impulses minus the target ones, shape (n,).
        friction: Coefficients of the points, shape (k,).
        least: Smallest impulses of the other rows, shape (n - 3 k,).
        most: Largest impulses of these rows, in the same form.
        impulses: The solution, shape (n,).
        rows: Which rows of the joints acted, as indices into those of all parts.
        pace: Target velocities of the ties.
        turning: Points that resist turning, as in `ContactProblem`.
    """

    parts: Sequence[Constraints]
    inverse: Vector
    along: Vector
    spread: Vector
    response: Vector
    free: Vector
    friction: Vector
    least: Vector
    most: Vector
    impulses: Vector
    rows: Indices
    pace: Vector
    turning: tuple[Index, Vector] | None = None


class Constraints:
    """The constraints of one robot or object in a step.

    Attributes:
        joints: Constraints of its joints.
        inverse: Returns the inverse of its mass matrix, shape (nv, nv).
        touching: Points that touch planes, or None.
        acts: Which rows of the joints act, shape (rows,).
        impulses: Impulses of the touching points along their axes, shape (k, 3), once known.
        nv: Length of its velocities.
        solved: What was solved, once it is, together with other robots that touch it.
    """

    def __init__(
        self,
        joints: JointConstraints,
        warmth: Warmth,
        inverse: Callable[[], Vector],
        touching: ContactPoints | None,
        positions: Vector,
        velocities: Vector,
        *,
        touched: bool,
    ) -> None:
        """Determine which rows of the joints act.

        Contacts may drive joints out of their limits, so nearby limits are included from the start
        and others as soon as they are violated. Without contacts, as in DART, only the limits that
        the free motion would violate act.

        Args:
            joints: Constraints of its joints.
            warmth: Impulses to start with.
            inverse: Returns the inverse of the mass matrix.
            touching: Points that touch planes.
            positions: Joint positions, shape (n,).
            velocities: Joint velocities without constraints, shape (n,).
            touched: Whether it touches anything.
        """
        self.joints, self.inverse, self.touching = joints, inverse, touching
        self._warmth, self._bounds = warmth, joints.bounds(positions)
        self.acts = joints.acting(self._bounds, velocities, _REACH if touched else 0.0)
        self.nv = joints.base + len(velocities)
        self.impulses = np.zeros((0, 3))
        self.solved: Solved | None = None

    def aims(self) -> Vector:
        """Return the target velocities of all rows, shape (rows,)."""
        return self.joints.aims(self._bounds)

    def rows(self) -> tuple[Indices, Vector, Vector, Vector, Vector]:
        """Return columns, smallest and largest impulses, targets, and last impulses of all rows."""
        joints = self.joints
        return joints.columns, joints.least, joints.most, self.aims(), self._warmth.rows

    def last(self) -> Vector:
        """Return the last impulses of the touching points, shape (3 k,)."""
        numbers = slice(0) if self.touching is None else self.touching.numbers
        return self._warmth.points[numbers].ravel()

    def add_missed(self, velocities: Vector) -> bool:
        """Activate the rows that velocities (nv,) require; return whether any were inactive."""
        ahead = self.joints.acting(self._bounds, velocities[self.joints.base :], -_MISSED)
        missed = ahead > self.acts
        self.acts |= missed
        return bool(np.count_nonzero(missed))

    def clear_warm_start(self) -> None:
        """Start the next step with no impulses."""
        self._warmth.clear_warm_start()

    def keep(self, points: Vector, rows: Vector) -> None:
        """Store the impulses of the touching points and of all rows."""
        self.impulses = points.reshape(-1, 3)
        self._warmth.points.fill(0.0)
        if self.touching is not None:
            self._warmth.points[self.touching.numbers] = self.impulses
        self._warmth.rows[:] = rows


def limited(part: Constraints, v: Vector) -> Vector:
    """Return the velocities after the impulses of the joint rows only."""
    joints, rows = part.joints, part.acts.nonzero()[0]
    part.clear_warm_start()
    if not len(rows):
        return v
    column, least, most = joints.columns[rows], joints.least[rows], joints.most[rows]
    inverse = part.inverse()
    spread = inverse.take(column, 1)
    response, change = spread[column], part.aims()[rows] - v[column]
    impulses, along = solve(response, change, least, most), unit(len(v)).take(column, 0)
    none = change[:0]
    part.solved = Solved(
        [part], inverse, along, spread, response, -change, none, least, most, impulses, rows, none
    )
    return v + spread.dot(impulses)


def constrained(
    parts: Sequence[Constraints],
    before: Vector,
    v: Vector,
    period: float,
    solver: ImpulseSolver,
    pairs: ContactPoints | None = None,
    warm: Vector | None = None,
    ties: tuple[Vector, Vector] | None = None,
) -> tuple[Vector, Vector]:
    """Return the velocities after the impulses of all constraints, and the impulses of pairs.

    Args:
        parts: Constraints of robots that touch something.
        before: Velocities of all of them before the step.
        v: Velocities that they would have without constraints.
        period: Length of the step, in s.
        solver: The solver.
        pairs: Contact points between them or with static shapes, k of them.
        warm: Impulses of these points to start with, shape (k, 3).
        ties: Jacobian (m, nv) of what is held together, and the velocities along its rows (m,).
    """
    ends = itertools.accumulate((part.nv for part in parts), initial=0)
    spans = [slice(*pair) for pair in itertools.pairwise(ends)]
    inverse = _diagonal([part.inverse() for part in parts], spans)
    touching = [] if pairs is None else [pairs]
    guess = [np.zeros(0) if warm is None else warm.ravel()]
    for part, span in zip(parts, spans, strict=True):
        if part.touching is not None:
            touching.append(part.touching.widened(span, len(v)))
        guess.append(part.last())
    points = joined([each.jacobian for each in touching]) if touching else np.zeros((0, len(v)))
    bias = joined([each.bias(before, period) for each in touching]) if touching else v[:0]
    friction = joined([each.friction for each in touching]) if touching else v[:0]
    of_parts = zip(*(part.rows() for part in parts), strict=True)
    columns, least, most, aims, last = (joined(each) for each in of_parts)
    spins = together(touching)
    more, fixed, endless, turning = _last_rows(ties, spins, len(v))
    if len(parts) > 1:
        starts, counts = [span.start for span in spans], [len(part.acts) for part in parts]
        columns = columns + np.repeat(starts, counts)
    missed = True
    while missed:
        rows = joined([part.acts for part in parts]).nonzero()[0]
        if len(parts) > 1:  # the solver expects rows with one bound first
            two_sided = np.isinf(least[rows]) == np.isinf(most[rows])
            rows = rows[np.argsort(two_sided, kind="stable")]
        jacobian = [points, unit(len(v)).take(columns[rows], 0)]
        targets, low, high = [bias, -aims[rows]], least[rows], most[rows]
        begin = [*guess, last[rows]]
        if len(fixed):
            jacobian.append(more)
            targets.append(fixed)
            begin.append(np.zeros(len(fixed)))
            low, high = np.concatenate([low, -endless]), np.concatenate([high, endless])
        along = np.concatenate(jacobian)
        spread = inverse.dot(along.T)
        response, free = along.dot(spread), along.dot(v) + np.concatenate(targets)
        if len(bias):
            first = np.concatenate(begin)
            impulses = solver.solve(response, free, friction, low, high, first, turning)
        else:
            impulses = solve(response, -free, low, high)
        after = v + spread.dot(impulses)
        missed = False
        for part, span in zip(parts, spans, strict=True):
            missed |= part.add_missed(after[span])
    solved = Solved(
        parts,
        *(inverse, along, spread, response, free, friction, low, high, impulses, rows),
        v[:0] if ties is None else ties[1],
        turning,
    )
    of_rows = np.zeros(len(columns))
    of_rows[rows] = impulses[len(bias) : len(bias) + len(rows)]
    _keep_turning(touching, impulses)
    point = ahead = len(guess[0])
    row = 0
    for part, warmed in zip(parts, guess[1:], strict=True):
        end, last_row = point + len(warmed), row + len(part.acts)
        part.keep(impulses[point:end], of_rows[row:last_row])
        part.solved = solved
        point, row = end, last_row
    return after, impulses[:ahead].reshape(-1, 3)


def _last_rows(
    ties: tuple[Vector, Vector] | None, spins: Spins | None, width: int
) -> tuple[Vector, Vector, Vector, tuple[Index, Vector] | None]:
    """Return Jacobian, velocities and bounds of the last rows, and what resists turning."""
    held, pace = (np.zeros((0, width)), np.zeros(0)) if ties is None else ties
    endless = np.full(len(pace), np.inf)
    if spins is None:
        return held, -pace, endless, None
    jacobian = np.concatenate([held, spins.jacobian])
    targets = -np.concatenate([pace, spins.drift])
    return jacobian, targets, endless, (spins.points, spins.bounds)


def _keep_turning(touching: Sequence[ContactPoints], impulses: Vector) -> None:
    """Store angular impulses, the last of all, where the points can be read."""
    for each in reversed(touching):
        if each.spins is not None:
            first = len(impulses) - len(each.spins.drift)
            each.spins.impulses[:] = impulses[first:].reshape(-1, 3)
            impulses = impulses[:first]


def _diagonal(blocks: Sequence[Vector], spans: Sequence[slice]) -> Vector:
    """Return a block-diagonal matrix."""
    if len(blocks) == 1:
        return blocks[0]
    found = np.zeros((spans[-1].stop, spans[-1].stop))
    for block, span in zip(blocks, spans, strict=True):
        found[span, span] = block
    return found
