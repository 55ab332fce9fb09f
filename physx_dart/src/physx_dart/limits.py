"""Joint limits, motors and Coulomb friction as impulses, once the free motion is known."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from physx_core.interfaces.backend import Vector
from physx_dart.urdf import Joint

_REGULARIZATION = 1e-9
"""Share that is added to the diagonal, as DART's solver does."""
_FASTEST_RETURN = 10.0
"""Speed in rad/s or m/s at which a joint comes back into its limits at most, as in DART."""


class JointConstraints:
    """Limits of position and velocity, motors, and Coulomb friction, of a robot's joints.

    A joint may not leave its limits in the next step, nor move faster than its velocity limit; one
    that is outside comes back, whatever its velocity limit. Friction stops a joint if it can within
    its bounds; a motor brings it to its velocity likewise. A motor without bounds does so whatever
    the limits are.

    Attributes:
        targets: Velocities that the motors aim at, shape (n,), in rad/s or m/s.
        acts: Whether anything but limits acts.
        limits: Whether any joint has limits.
    """

    def __init__(self, joints: Sequence[Joint], period: float) -> None:
        """Keep the bounds of all joints, and the period in s."""
        modes = np.array([joint.settings.mode for joint in joints], dtype=object)
        self._lower = np.array([joint.lower for joint in joints])
        self._upper = np.array([joint.upper for joint in joints])
        self._fastest = np.array([joint.max_velocity for joint in joints])
        self._friction = period * np.array([joint.friction for joint in joints])
        self._motors = modes != "force"
        free = modes == "velocity"
        self._lower[free], self._upper[free], self._fastest[free] = -np.inf, np.inf, np.inf
        self._friction[free] = 0.0
        strength = np.array([joint.max_torque for joint in joints])
        self._strength = np.where(free, np.inf, period * strength)
        self._rubs = bool(self._friction.any())
        self._period = period
        self.targets = np.zeros(len(joints))
        self.acts = self._rubs or bool(self._motors.any())
        limits = np.concatenate([self._lower, self._upper, self._fastest])
        self.limits = bool(np.isfinite(limits).any())
        self._ranges = [
            (place, float(lower), float(upper))
            for place, (lower, upper) in enumerate(zip(self._lower, self._upper, strict=True))
            if lower > -math.inf or upper < math.inf
        ]
        self._slowest_limit = float(self._fastest.min(initial=np.inf))

    def safe(self, positions: Vector, velocities: Vector) -> tuple[int, float]:
        """Return for how many steps no limit can act while the speed stays below a bound.

        Args:
            positions: Shape (n,).
            velocities: Likewise.

        Returns:
            The number of steps and the bound of the square of the velocities' length.
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

    def impulses(
        self, positions: Vector, velocities: Vector
    ) -> tuple[NDArray[np.intp], Vector, Vector, Vector] | None:
        """Return what has to change, or None where the free motion is allowed.

        Args:
            positions: Before the step, shape (n,).
            velocities: After the step if nothing stopped the joints, shape (n,).

        Returns:
            Four vectors of one length: which degrees of freedom (one may be there twice), by how
            much their velocities shall change, and the smallest and the largest impulse on them.
        """
        if not self.acts and self._allows(positions, velocities):
            return None
        below, above = positions < self._lower, positions > self._upper
        to_lower = (self._lower - positions) / self._period
        to_upper = (self._upper - positions) / self._period
        outside = below | above
        slowest = np.where(below, to_lower, np.maximum(-self._fastest, to_lower))
        slowest = np.minimum(slowest, _FASTEST_RETURN)
        fastest = np.where(above, to_upper, np.minimum(self._fastest, to_upper))
        fastest = np.maximum(fastest, -_FASTEST_RETURN)
        low = below | ((velocities < slowest) & ~outside)
        high = above | ((velocities > fastest) & ~outside & ~low)
        rubs, motors = (self._friction > 0) & (velocities != 0), self._motors
        index = np.concatenate([np.flatnonzero(rows) for rows in (low, high, rubs, motors)])
        if not len(index):
            return None
        nothing, friction = np.zeros(len(velocities)), self._friction
        strength = self._strength[motors]
        aims = [slowest[low], fastest[high], nothing[rubs], self.targets[motors]]
        target = np.concatenate(aims)
        least = np.concatenate([nothing[low], nothing[high] - np.inf, -friction[rubs], -strength])
        most = np.concatenate([nothing[low] + np.inf, nothing[high], friction[rubs], strength])
        return index, target - velocities[index], least, most

    def _allows(self, positions: Vector, velocities: Vector) -> bool:
        """Return whether no limit acts on a free motion."""
        after = positions + self._period * velocities
        return bool(
            (after >= self._lower).all()
            and (after <= self._upper).all()
            and (np.abs(velocities) <= self._fastest).all()
        )


def solve(response: Vector, change: Vector, least: Vector, most: Vector) -> Vector:
    """Return the impulses that bring about a change of velocities as far as their bounds allow.

    They solve the box-constrained linear complementarity problem by principal pivoting: blocks of
    pivots as long as they help, else single ones, which always end (J. J. Judice and F. M. Pires,
    A block principal pivoting algorithm for large-scale strictly monotone linear complementarity
    problems, Computers & Operations Research 21, 1994).

    Args:
        response: Change of the velocities for unit impulses, shape (n, n), positive definite.
        change: Wanted change of the velocities, shape (n,).
        least: Smallest impulses, shape (n,), may be -inf.
        most: Largest impulses, likewise.
    """
    matrix = response + np.diag(_REGULARIZATION * np.diag(response))
    side = np.zeros(len(change), dtype=np.int8)  # -1: at its least, 1: at its most, 0: between
    best, blocks = len(change) + 1, 3
    impulses = np.zeros(len(change))
    for _ in range(50 * (len(change) + 1)):
        free = side == 0
        impulses = np.where(side < 0, least, np.where(side > 0, most, 0.0))
        if free.any():
            rest = change[free] - matrix[np.ix_(free, ~free)] @ impulses[~free]
            impulses[free] = np.linalg.solve(matrix[np.ix_(free, free)], rest)
        missing = matrix @ impulses - change
        under, over = free & (impulses < least), free & (impulses > most)
        freed = ((side < 0) & (missing < 0)) | ((side > 0) & (missing > 0))
        wrong = np.flatnonzero(under | over | freed)
        if not len(wrong):
            break
        if len(wrong) < best:
            best, blocks = len(wrong), 3
        elif blocks:
            blocks -= 1
        else:
            wrong = wrong[-1:]
        side[wrong] = np.where(freed[wrong], 0, np.where(under[wrong], -1, 1))
    return np.clip(impulses, least, most)
