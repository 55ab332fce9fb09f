"""Constraints of robots and objects in a step, solved together where they touch."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_dart.pinocchio.contacts import ContactPoints, Indices
from physx_dart.pinocchio.limits import JointConstraints, solve
from physx_dart.pinocchio.solver import ImpulseSolver

_REACH = 1.0
"""Margin in rad/s or m/s within which a limit takes part while there are contacts."""
_MISSED = 1e-9
"""Excess of a velocity over its bound at which a joint counts as out of its limits."""


class Warmth:
    """Impulses of a robot's last step, with which the next one begins.

    Args:
        points: Upper bound of `ContactPoints.numbers`.
        rows: Number of rows of its joints.
    """

    def __init__(self, points: int, rows: int) -> None:
        self.points, self.rows = np.zeros((points, 3)), np.zeros(rows)

    def forget(self) -> None:
        """Begin with no impulses."""
        self.points.fill(0.0)
        self.rows.fill(0.0)


class Constraints:
    """The constraints of one robot or object in a step.

    Attributes:
        touching: Points that touch planes, or None.
        impulses: Impulses of these points along their axes, shape (k, 3), once they are known.
        base: Degrees of freedom of the robot's base.
        nv: Length of its velocities.
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
        base: int,
        touched: bool,
    ) -> None:
        """Note which rows of the joints act.

        Contacts may drive joints out of their limits, so limits that are close take part from the
        beginning, and others as soon as they are violated. Without contacts, as in DART, the limits
        that the free motion would violate act.

        Args:
            joints: Constraints of its joints.
            warmth: Impulses to begin with.
            inverse: Returns the inverse of the mass matrix.
            touching: Points that touch planes.
            positions: Of the joints, shape (n,).
            velocities: Of the joints, without constraints.
            base: Degrees of freedom of its base.
            touched: Whether it touches anything.
        """
        self.joints, self.warmth, self.touching = joints, warmth, touching
        self._invert = inverse
        self._inverse: Vector | None = None
        self.bounds = joints.bounds(positions)
        self.acts = joints.acting(self.bounds, velocities, _REACH if touched else 0.0)
        self.base, self.nv = base, base + len(velocities)
        self.impulses = np.zeros((0, 3))

    @property
    def inverse(self) -> Vector:
        """The inverse of the mass matrix, shape (nv, nv)."""
        if self._inverse is None:  # `cached_property` locks, which takes longer than this
            self._inverse = self._invert()
        return self._inverse

    def rows(self) -> Indices:
        """Return the rows of the joints that act."""
        found: Indices = self.acts.nonzero()[0]
        return found

    def limits(self, rows: Indices) -> tuple[Indices, Vector, Vector, Vector, Vector]:
        """Return columns, smallest and largest impulses, aims, and last impulses of some rows."""
        joints, column = self.joints, self.joints.joints[rows] + self.base
        least, most, aims = joints.least[rows], joints.most[rows], joints.aims(self.bounds)[rows]
        return column, least, most, aims, self.warmth.rows[rows]

    def add_missed(self, velocities: Vector) -> bool:
        """Let limits that velocities (nv,) violate act; return whether there are any."""
        if not self.joints.violated(self.bounds, velocities[self.base :], _MISSED):
            return False
        ahead = self.joints.acting(self.bounds, velocities[self.base :], -_MISSED)
        missed = ahead & ~self.acts
        self.acts |= missed
        return bool(missed.any())

    def keep(self, points: Vector, rows: Indices, impulses: Vector) -> None:
        """Keep the impulses of points and rows."""
        self.impulses, warmth = points.reshape(-1, 3), self.warmth
        warmth.forget()
        if self.touching is not None:
            warmth.points[self.touching.numbers] = self.impulses
        warmth.rows[rows] = impulses


def limited(part: Constraints, v: Vector) -> Vector:
    """Return the velocities after the impulses of the rows of the joints alone."""
    joints, rows = part.joints, part.rows()
    part.warmth.forget()
    if not len(rows):
        return v
    index = joints.joints[rows] + part.base
    spread = part.inverse[:, index]
    change = joints.aims(part.bounds)[rows] - v[index]
    return v + spread @ solve(spread[index], change, joints.least[rows], joints.most[rows])


def constrained(
    parts: Sequence[Constraints],
    before: Vector,
    v: Vector,
    period: float,
    solver: ImpulseSolver,
    pairs: ContactPoints | None = None,
    warm: Vector | None = None,
) -> tuple[Vector, Vector]:
    """Return the velocities after the impulses of all constraints, and the impulses of pairs.

    Args:
        parts: Constraints of robots that touch something.
        before: Velocities of all of them before the step.
        v: Velocities that they would have without constraints.
        period: Length of the step, in s.
        solver: The solver.
        pairs: Points between them, or with static shapes, shape (k,).
        warm: Impulses of these points to begin with, shape (k, 3).
    """
    ends = list(itertools.accumulate((part.nv for part in parts), initial=0))
    spans = [slice(*pair) for pair in itertools.pairwise(ends)]
    inverse = _diagonal([part.inverse for part in parts], spans)
    touching = [] if pairs is None else [pairs]
    guess = [] if warm is None else [warm.ravel()]
    for part, span in zip(parts, spans, strict=True):
        if part.touching is not None:
            touching.append(part.touching.widened(span, len(v)))
            guess.append(part.warmth.points[part.touching.numbers].ravel())
    points = joined([each.jacobian for each in touching])
    wanted = -joined([each.bias(before, period) for each in touching])
    friction, unit = joined([each.friction for each in touching]), np.eye(len(v))
    while True:
        rows = [part.rows() for part in parts]
        limits = [part.limits(some) for part, some in zip(parts, rows, strict=True)]
        column = joined(
            [joint + span.start for (joint, *_), span in zip(limits, spans, strict=True)]
        )
        least, most, aims, begin = (
            joined(list(each)) for each in list(zip(*limits, strict=True))[1:]
        )
        order: Any = slice(None)
        if len(parts) > 1:  # the solver wants rows with one bound first
            order = np.argsort(np.isinf(least) == np.isinf(most), kind="stable")
        jacobian = np.concatenate([points, unit.take(column[order], 0)])
        spread = inverse @ jacobian.T
        impulses = solver.solve(
            jacobian @ spread,
            jacobian @ v - np.concatenate([wanted, aims[order]]),
            friction,
            least[order],
            most[order],
            np.concatenate([*guess, begin[order]]),
        )
        after = v + spread @ impulses
        missed = [part.add_missed(after[span]) for part, span in zip(parts, spans, strict=True)]
        if not any(missed):
            break
    of_rows = np.empty(len(column))
    of_rows[order] = impulses[len(wanted) :]
    first = place = 0 if pairs is None else 3 * len(pairs.gaps)
    of_pairs, last = impulses[:first].reshape(-1, 3), 0
    for part, some in zip(parts, rows, strict=True):
        count = 0 if part.touching is None else 3 * len(part.touching.gaps)
        part.keep(impulses[place : place + count], some, of_rows[last : last + len(some)])
        place, last = place + count, last + len(some)
    return after, of_pairs


def _diagonal(blocks: Sequence[Vector], spans: Sequence[slice]) -> Vector:
    """Return a matrix with these blocks on its diagonal."""
    if len(blocks) == 1:
        return blocks[0]
    found = np.zeros((spans[-1].stop, spans[-1].stop))
    for block, span in zip(blocks, spans, strict=True):
        found[span, span] = block
    return found


def joined(arrays: Sequence[Any]) -> Any:
    """Return arrays one after the other."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
