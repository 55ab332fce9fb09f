"""Impulses from joint limits, motors, and Coulomb friction, given the free motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import eigenpy
import numpy as np
from numpy.typing import NDArray

from physx_core.typing import Vector
from physx_dart.pinocchio.contact_problem import regularized, unit
from physx_sim.engines import Joint

Indices = NDArray[np.intp]

_FASTEST_RETURN = 10.0
"""Maximum speed, in rad/s or m/s, at which a joint returns to within its limits, as in DART."""


class JointConstraints:
    """Position and velocity limits, motors, and Coulomb friction of a robot's joints.

    A joint must not leave its limits in the next step, nor exceed its velocity limit; a joint
    outside its limits returns, regardless of its velocity limit. Friction stops a joint and a motor
    brings it to its target velocity as far as their bounds allow. A motor without bounds ignores
    the limits.

    Each constraint is a row: a direction, a target velocity and bounds on the impulse. The lower
    limits of all joints come first, then the upper limits, whose directions are downward, then
    friction and motors, if any.

    Attributes:
        base: Degrees of freedom of the robot's base.
        columns: Index of each row's joint in the robot's velocities, shape (rows,).
        jacobian: Directions of the rows, 1 or -1 at their joints, shape (rows, nv).
        least: Smallest impulse of each row, in N m s or N s, shape (rows,).
        most: Largest impulse of each row, in the same form.
        targets: Target velocities of the motors, shape (n,), in rad/s or m/s.
        acts: Whether there is friction or a motor.
        limits: Whether any joint has limits.
    """

    def __init__(self, joints: Sequence[Joint], period: float, base: int) -> None:
        """Store the bounds of all joints, the period in s, and the base's degrees of freedom."""
        self.base = base
        modes = np.array([joint.mode for joint in joints], dtype=object)
        lower = np.array([joint.lower for joint in joints])
        upper = np.array([joint.upper for joint in joints])
        fastest = np.array([joint.max_velocity for joint in joints])
        friction = period * np.array([joint.friction for joint in joints])
        strength = period * np.array([joint.max_torque for joint in joints])
        free = modes == "velocity"
        lower[free], upper[free], fastest[free] = -np.inf, np.inf, np.inf
        friction[free], strength[free] = 0.0, np.inf
        self._rubs, self._motors = np.flatnonzero(friction), np.flatnonzero(modes != "force")
        self._arrange(friction[self._rubs], strength[self._motors], len(joints))
        self._pace = 1 / period
        # Lists, because operations on short arrays take longer.
        limits = self._pace * lower, self._pace * upper, -fastest
        self._limits = list(zip(*(each.tolist() for each in limits), strict=True))
        self._period = period
        self.targets = np.zeros(len(joints))
        self.acts = bool(len(self._rubs) or len(self._motors))
        self.limits = bool(np.isfinite([lower, upper, fastest]).any())
        self._ranges = [
            (place, float(low), float(high))
            for place, (low, high) in enumerate(zip(lower, upper, strict=True))
            if low > -math.inf or high < math.inf
        ]
        self._slowest_limit = float(fastest.min(initial=np.inf))

    def _arrange(self, friction: Vector, strength: Vector, n: int) -> None:
        """Set the constant parts of the rows."""
        nothing, places = np.zeros(n), np.arange(n)
        joints = np.concatenate([places, places, self._rubs, self._motors])
        self.columns = joints + self.base
        self.jacobian = unit(self.base + n)[self.columns]
        self.jacobian[n : 2 * n] *= -1.0
        self.least = np.concatenate([nothing, nothing, -friction, -strength])
        self.most = np.concatenate([nothing + np.inf, nothing + np.inf, friction, strength])

    def safe(self, positions: Vector, velocities: Vector) -> tuple[int, float]:
        """Return for how many steps no limit can act while the speed stays below a bound.

        Args:
            positions: Shape (n,).
            velocities: Shape (n,).

        Returns:
            The number of steps, and the bound on the squared norm of the velocities.
        """
        if not self.limits:
            return 2**30, math.inf
        square = float(velocities.dot(velocities))
        bound = min(self._slowest_limit, max(2 * math.sqrt(square), 1.0))
        slack, places = math.inf, positions.tolist()
        for place, lower, upper in self._ranges:
            slack = min(slack, places[place] - lower, upper - places[place])
        if not slack > 0 or not square < bound * bound:
            return 0, 0.0
        return int(min(slack / (bound * self._period), 2**30)), bound * bound

    def bounds(self, positions: Vector) -> list[float]:
        """Return the least velocities of joints, upward for lower and downward for upper limits.

        Args:
            positions: Positions before the step, shape (n,).

        Returns:
            For each lower, then each upper limit, in rad/s or m/s: mostly negative, because most
            joints need not move.
        """
        pace, upward, downward = self._pace, [], []
        for place, (lower, upper, slowest) in zip(positions.tolist(), self._limits, strict=True):
            at = pace * place
            up, down = lower - at, at - upper
            if up > 0 or down > 0:  # outside: it returns regardless of its velocity limit
                up, down = min(up, _FASTEST_RETURN), min(down, _FASTEST_RETURN)
            else:
                up, down = up if up > slowest else slowest, down if down > slowest else slowest
            upward.append(up)
            downward.append(down)
        return upward + downward

    def acting(self, bounds: list[float], velocities: Vector, reach: float) -> list[int]:
        """Return the rows that act: motors, friction of moving joints, and some limits.

        Limits of joints outside them always act, because other joints may push them further out.

        Args:
            bounds: As returned by `bounds`.
            velocities: Velocities after the step, shape (n,).
            reach: Margin above its bound at which a velocity makes a limit act.
        """
        speeds, first = velocities.tolist(), len(bounds)
        along = zip(range(first), speeds + [-speed for speed in speeds], bounds, strict=True)
        acts = [row for row, speed, least in along if speed < least + reach or least > 0]
        if self.acts:
            # A joint that is at rest without friction stays so, as in DART.
            acts += [first + row for row, joint in enumerate(self._rubs.tolist()) if speeds[joint]]
            acts += range(first + len(self._rubs), len(self.columns))
        return acts

    def slopes(self, positions: Vector) -> Vector:
        """Return the derivative of each row's target velocity by its joint's position, (rows,).

        Args:
            positions: Positions before the step, shape (n,).
        """
        lower, upper, _ = np.array(self._limits).reshape(-1, 3).T
        needed = np.concatenate([lower - self._pace * positions, self._pace * positions - upper])
        found, pace = np.zeros(len(self.columns)), np.repeat([-self._pace, self._pace], len(lower))
        found[: len(needed)] = np.where(self.bounds(positions) == needed, pace, 0.0)
        return found

    def motors(self) -> Vector:
        """Return 1 for rows of motors, otherwise 0, shape (rows,)."""
        found = np.zeros(len(self.columns))
        found[len(found) - len(self._motors) :] = 1.0
        return found

    def resting(self, velocities: Vector) -> Indices:
        """Return the rows of friction of joints that are at rest without it."""
        first = 2 * len(self.targets)
        still: Indices = first + (velocities[self._rubs] == 0).nonzero()[0]
        return still

    def aims(self, bounds: list[float]) -> Vector:
        """Return the target velocity of each row, shape (rows,)."""
        if not self.acts:
            return np.array(bounds)
        return np.concatenate([bounds, np.zeros(len(self._rubs)), self.targets[self._motors]])


def solve(response: Vector, change: Vector, least: Vector, most: Vector) -> Vector:
    """Return the impulses that cause a velocity change as far as their bounds allow.

    They solve the box-constrained linear complementarity problem by principal pivoting: with block
    pivots as long as they help, otherwise with single pivots, which always terminate (J. J. Judice
    and F. M. Pires, A block principal pivoting algorithm for large-scale strictly monotone linear
    complementarity problems, Computers & Operations Research 21, 1994).

    Args:
        response: Velocity change for unit impulses, shape (n, n), positive definite.
        change: Desired velocity change, shape (n,).
        least: Smallest impulses, shape (n,), may be -inf.
        most: Largest impulses, shape (n,), may be inf.
    """
    n, matrix = len(change), regularized(response)
    alone = change / matrix.diagonal()
    if n == 1:
        return np.minimum(np.maximum(alone, least), most)
    # Lists, because operations on short arrays take longer.
    bounds = list(zip(least.tolist(), most.tolist(), strict=True))
    # -1: at the lower bound, 1: at the upper, 0: between; initially as if rows were independent.
    sides = _sides(alone, bounds)
    best, blocks = n + 1, 3
    for _ in range(50 * (n + 1)):
        impulses = _pivoted(matrix, change, sides, bounds)
        right = _sides(impulses, bounds)
        if any(sides):
            excess = (matrix.dot(impulses) - change).tolist()
            for place, side in enumerate(sides):
                if side:
                    right[place] = 0 if side * excess[place] > 0 else side
        if right == sides:
            return impulses
        wrong = [place for place, side in enumerate(right) if side != sides[place]]
        if len(wrong) < best:
            best, blocks = len(wrong), 3
        elif blocks:
            blocks -= 1
        else:
            wrong = wrong[-1:]
        for place in wrong:
            sides[place] = right[place]
    return np.minimum(np.maximum(impulses, least), most)


def _sides(impulses: Vector, bounds: list[tuple[float, float]]) -> list[int]:
    """Return -1 for each impulse below its bounds, 1 for each above, otherwise 0."""
    pairs = zip(impulses.tolist(), bounds, strict=True)
    return [(impulse > most) - (impulse < least) for impulse, (least, most) in pairs]


def _pivoted(
    matrix: Vector, change: Vector, sides: list[int], bounds: list[tuple[float, float]]
) -> Vector:
    """Return the impulses (n,) with rows on a side held at their bounds and the rest solved."""
    held = [(place, bounds[place][side > 0]) for place, side in enumerate(sides) if side]
    system, wanted = (matrix.copy(), change.copy()) if held else (matrix, change)
    for place, bound in held:
        system[place], wanted[place] = unit(len(change))[place], bound
    impulses: Vector = eigenpy.PartialPivLU(system).solve(wanted)
    for place, bound in held:  # exactly
        impulses[place] = bound
    return impulses
