"""Forward dynamics of many states at once, with derivatives."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pinocchio

from physx_core.interfaces.backend import Vector
from physx_dart.algorithms import Algorithms, MoverAlgorithms


class MoverBatches:
    """Forward dynamics of many states of one robot or object; each row is a state."""

    def __init__(self, mover: MoverAlgorithms) -> None:
        self.model, self._data, self._resistance = mover.model, mover.data, mover.resistance
        self._pool = pinocchio.ModelPool(mover.model, 1)

    def forward(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (n, nv), resistance included."""
        out = np.zeros((self.model.nv, len(q)), order="F")
        if out.size:
            resisted = tau - self._resistance.torques(q, v)
            columns = [np.ascontiguousarray(rows).T for rows in (q, v, resisted)]
            pinocchio.abaInParallel(1, self._pool, *columns, out)
        return out.T

    def derivatives(self, q: Vector, v: Vector, tau: Vector) -> tuple[Vector, Vector]:
        """Return the accelerations (n, nv), and what they are derived to.

        Derivatives by motions along the velocities, by velocities and by torques are one array of
        shape (3, n, nv, nv), in this order.
        """
        model, data, derive = self.model, self._data, pinocchio.computeABADerivatives
        resistance = self._resistance
        a, found = np.empty(v.shape), np.empty((3, *v.shape, model.nv))
        by_q, by_v, by_tau = found
        rows = zip(q, v, tau - resistance.torques(q, v), strict=True)
        for i, state in enumerate(rows):
            by_q[i], by_v[i], by_tau[i] = derive(model, data, *state)
            a[i] = data.ddq
        if resistance.stiffness.any():
            by_q -= by_tau * resistance.stiffness
        if resistance.damping.any():
            by_v -= by_tau * resistance.damping
        return a, found


class Batches:
    """Forward dynamics of many states of a world; each row is a state. Nothing is checked here."""

    def __init__(self, algorithms: Algorithms) -> None:
        self._movers = [MoverBatches(mover) for mover in algorithms.movers]

    def forward(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (n, nv)."""
        found = [x.forward(q[:, a], v[:, b], tau[:, b]) for x, a, b in self._slices()]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def derivatives(self, q: Vector, v: Vector, tau: Vector) -> tuple[Vector, Vector]:
        """Return the accelerations (n, nv) and their derivatives (3, n, nv, nv)."""
        if len(self._movers) == 1:
            return self._movers[0].derivatives(q, v, tau)
        a, found = np.empty(v.shape), np.zeros((3, *v.shape, v.shape[1]))
        for each, i, j in self._slices():
            a[:, j], found[:, :, j, j] = each.derivatives(q[:, i], v[:, j], tau[:, j])
        return a, found

    def _slices(self) -> Iterator[tuple[MoverBatches, slice, slice]]:
        nq = nv = 0
        for each in self._movers:
            model = each.model
            yield each, slice(nq, nq + model.nq), slice(nv, nv + model.nv)
            nq, nv = nq + model.nq, nv + model.nv
