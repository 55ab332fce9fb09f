"""Constraints of robots and objects in a step, solved together where they touch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from physx_core.typing import Index, Vector
from physx_dart.pinocchio.contacts import ContactPoints, Indices, joined, together, widened
from physx_dart.pinocchio.limits import JointConstraints, solve
from physx_dart.pinocchio.solver import ImpulseSolver

_REACH = 1.0
"""Margin, in rad/s or m/s, within which a limit is included while there are contacts."""
_NOTHING = np.zeros((0, 3))
_MISSED = 1e-9
"""Excess of a velocity over its bound at which a joint counts as outside its limits."""


class Warmth:
    """Impulses from a robot's last step, used to warm-start the next one.

    Args:
        points: Upper bound on `ContactPoints.numbers`.
        rows: Number of constraint rows of its joints.

    Attributes:
        points: Impulses of points by their numbers, shape (points, 3).
        rows: Impulses of the rows, shape (rows,).
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

    Velocities are those of the robots that were solved together, one after the other.

    Attributes:
        inverse: Inverse of the mass matrix, shape (nv, nv).
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
        warmth: Impulses to start with.
        inverse: Returns the inverse of its mass matrix, shape (nv, nv).
        touching: Points that touch planes, or None.
        acts: The rows of the joints that act.
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
        self.warmth, self._bounds = warmth, joints.bounds(positions)
        self.acts = joints.acting(self._bounds, velocities, _REACH if touched else 0.0)
        self.nv = joints.base + len(velocities)
        self.impulses = _NOTHING
        self.solved: Solved | None = None

    def aims(self) -> Vector:
        """Return the target velocities of all rows, shape (rows,)."""
        return self.joints.aims(self._bounds)

    def add_missed(self, velocities: Vector) -> bool:
        """Activate the rows that velocities (nv,) require; return whether any were inactive."""
        ahead = self.joints.acting(self._bounds, velocities[self.joints.base :], -_MISSED)
        missed = [row for row in ahead if row not in self.acts]
        if missed:
            self.acts = sorted(self.acts + missed)
        return bool(missed)

    def keep(self, points: Vector, rows: Vector) -> None:
        """Store the impulses of the touching points and of all rows."""
        self.impulses = points.reshape(-1, 3)
        self.warmth.points.fill(0.0)
        if self.touching is not None:
            self.warmth.points[self.touching.numbers] = self.impulses
        self.warmth.rows = rows


def limited(part: Constraints, v: Vector) -> Vector:
    """Return the velocities after the impulses of the joint rows only."""
    part.warmth.clear_warm_start()
    if not part.acts:
        return v
    joints, rows = part.joints, np.array(part.acts)
    inverse, along = part.inverse(), joints.jacobian.take(rows, 0)
    spread = inverse.dot(along.T)
    response, change = along.dot(spread), part.aims().take(rows) - along.dot(v)
    least, most, none = joints.least.take(rows), joints.most.take(rows), v[:0]
    impulses = solve(response, change, least, most)
    part.solved = Solved(
        inverse, along, spread, response, -change, none, least, most, impulses, rows, none
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
    group = _Group(parts, before, v, period, pairs, warm, ties)
    missed = True
    while missed:
        solved = group.solve(v, solver)
        after = v + solved.spread.dot(solved.impulses)
        missed = group.add_missed(after)
    return after, group.keep(solved)


class _Group:
    """Constraints that are solved together, with all that does not depend on which limits act."""

    def __init__(
        self,
        parts: Sequence[Constraints],
        before: Vector,
        v: Vector,
        period: float,
        pairs: ContactPoints | None,
        warm: Vector | None,
        ties: tuple[Vector, Vector] | None,
    ) -> None:
        """Collect the constraints; the arguments are those of `constrained`."""
        nothing, width = v[:0], len(v)
        self._parts, self._spans = parts, _spans([part.nv for part in parts])
        self._of_rows = _spans([len(part.joints.columns) for part in parts])
        wide = list(zip(parts, self._spans, strict=True))
        self._touching = touching = [] if pairs is None else [pairs]
        guess = [] if warm is None else [warm.ravel()]
        for part, span in wide:
            if part.touching is not None:
                touching.append(part.touching.widened(span, width))
                guess.append(part.warmth.points.take(part.touching.numbers, 0).ravel())
        self._of_pairs = 0 if pairs is None else 3 * len(pairs.gaps)
        self._inverse = _diagonal([part.inverse() for part in parts], self._spans)
        self._points = np.zeros((0, width))
        self._bias = self._friction = self._guess = self._pace = nothing
        if touching:
            self._points = joined([each.jacobian for each in touching])
            self._bias = joined([each.bias(before, period) for each in touching])
            self._friction = joined([each.friction for each in touching])
            self._guess = joined(guess)
        self._least = joined([part.joints.least for part in parts])
        self._most = joined([part.joints.most for part in parts])
        self._aims = joined([part.aims() for part in parts])
        self._last = joined([part.warmth.rows for part in parts])
        self._joints = joined([widened(part.joints.jacobian, span, width) for part, span in wide])
        self._turning = None
        self._more: list[Vector] = []  # Jacobians of further rows
        self._targets: list[Vector] = []
        if ties is not None:
            self._pace = ties[1]
            self._more, self._targets = [ties[0]], [-self._pace]
        if (spins := together(touching)) is not None:
            self._turning = spins.points, spins.bounds
            self._more.append(spins.jacobian)
            self._targets.append(-spins.drift)

    def solve(self, v: Vector, solver: ImpulseSolver) -> Solved:
        """Return the impulses of all constraints, with the rows of joints that act."""
        pairs = zip(self._parts, self._of_rows, strict=True)
        rows = np.array([span.start + row for part, span in pairs for row in part.acts], np.intp)
        least, most = self._least.take(rows), self._most.take(rows)
        if len(self._parts) > 1:  # the solver expects rows with one bound first
            order = np.argsort(np.isinf(least) == np.isinf(most), kind="stable")
            rows, least, most = rows[order], least[order], most[order]
        along = np.concatenate([self._points, self._joints.take(rows, 0), *self._more])
        targets = np.concatenate([self._bias, -self._aims.take(rows), *self._targets])
        if len(self._pace):
            endless = np.full(len(self._pace), np.inf)
            least, most = np.concatenate([least, -endless]), np.concatenate([most, endless])
        spread = self._inverse.dot(along.T)
        response, free = along.dot(spread), along.dot(v) + targets
        if len(self._bias):
            none = (np.zeros(len(each)) for each in self._targets)
            guess = np.concatenate([self._guess, self._last.take(rows), *none])
            impulses = solver.solve(
                response, free, self._friction, least, most, guess, self._turning
            )
        else:
            impulses = solve(response, -free, least, most)
        return Solved(
            *(self._inverse, along, spread, response, free, self._friction),
            *(least, most, impulses, rows, self._pace, self._turning),
        )

    def add_missed(self, velocities: Vector) -> bool:
        """Activate the rows of joints that velocities require; return whether any were inactive."""
        pairs = zip(self._parts, self._spans, strict=True)
        missed = [part.add_missed(velocities[span]) for part, span in pairs]
        return any(missed)

    def keep(self, solved: Solved) -> Vector:
        """Store the impulses where they can be read; return those of pairs, shape (k, 3)."""
        impulses, rows = solved.impulses, solved.rows
        of_rows = np.zeros(len(self._last))
        of_rows[rows] = impulses[len(self._bias) : len(self._bias) + len(rows)]
        if self._turning is not None:
            _keep_turning(self._touching, impulses)
        end = self._of_pairs
        for part, span in zip(self._parts, self._of_rows, strict=True):
            begin = end
            if part.touching is not None:
                end += 3 * len(part.touching.gaps)
            part.keep(impulses[begin:end], of_rows[span])
            part.solved = solved
        return impulses[: self._of_pairs].reshape(-1, 3)


def _keep_turning(touching: Sequence[ContactPoints], impulses: Vector) -> None:
    """Store angular impulses, the last of all, where the points can be read."""
    for each in reversed(touching):
        if each.spins is not None:
            first = len(impulses) - len(each.spins.drift)
            each.spins.impulses[:] = impulses[first:].reshape(-1, 3)
            impulses = impulses[:first]


def _spans(lengths: Sequence[int]) -> list[slice]:
    """Return the slices of parts that follow each other."""
    if len(lengths) == 1:
        return [slice(0, lengths[0])]
    ends = itertools.accumulate(lengths, initial=0)
    return [slice(*pair) for pair in itertools.pairwise(ends)]


def _diagonal(blocks: Sequence[Vector], spans: Sequence[slice]) -> Vector:
    """Return a block-diagonal matrix."""
    if len(blocks) == 1:
        return blocks[0]
    found = np.zeros((spans[-1].stop, spans[-1].stop))
    for block, span in zip(blocks, spans, strict=True):
        found[span, span] = block
    return found
