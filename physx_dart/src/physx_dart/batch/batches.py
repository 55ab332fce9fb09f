"""Forward dynamics of many states at once, and its gradients."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pinocchio

from physx_core.typing import Vector
from physx_dart.shared.resistance import Resistance


class MoverBatchDynamics:
    """Forward dynamics of many states of a robot or object; each row is a state.

    Attributes:
        model: Pinocchio's model, with gravity and the rotors' inertia.
        resistance: Resistance of its joints.
    """

    def __init__(self, model: Any, resistance: Resistance) -> None:
        self.model, self.resistance = model, resistance
        self._data, self._pool = model.createData(), pinocchio.ModelPool(model, 1)

    def forward(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (n, nv), with joint resistance."""
        out = np.zeros((self.model.nv, len(q)), order="F")
        if out.size:
            resisted = tau - self.resistance.torques(q, v)
            columns = [np.ascontiguousarray(rows).T for rows in (q, v, resisted)]
            pinocchio.abaInParallel(1, self._pool, *columns, out)
        return out.T

    def gradients(self, q: Vector, v: Vector, a: Vector, weights: Vector) -> Vector:
        """Return the gradients of ``weights @ accelerations``, shape (3, n, nv).

        With r(q, v, a) the torques of the inverse dynamics and M its derivative by a, they are
        x = weights / M by the torques, -x dr/dq by the positions and -x dr/dv by the velocities.
        The derivatives of the inverse dynamics take two thirds of the time of those of the forward
        dynamics, and yield M as well.
        """
        model, data, resistance = self.model, self._data, self.resistance
        derive, dot = pinocchio.computeRNEADerivatives, np.dot
        decompose, solve = pinocchio.cholesky.decompose, pinocchio.cholesky.solve
        found = np.empty((3, *weights.shape))
        by_q, by_v, by_tau = found
        for q_i, v_i, a_i, given, to_q, to_v, to_tau in zip(
            q, v, a, weights, by_q, by_v, by_tau, strict=True
        ):
            r_by_q, r_by_v, _ = derive(model, data, q_i, v_i, a_i)
            decompose(model, data)
            to_tau[:] = solve(model, data, given)
            dot(to_tau, r_by_q, out=to_q)
            dot(to_tau, r_by_v, out=to_v)
        by_q += by_tau * resistance.stiffness
        by_v += by_tau * resistance.damping
        np.negative(found[:2], out=found[:2])
        return found


class BatchDynamics:
    """Forward dynamics of many states of a world; each row is a state. Arrays are not validated.

    Attributes:
        movers: One for each robot, then for each moving object.
        nq: Length of the positions.
        nv: Length of the velocities.
    """

    def __init__(self, movers: Sequence[MoverBatchDynamics]) -> None:
        self.movers = movers
        self.nq = sum(each.model.nq for each in movers)
        self.nv = sum(each.model.nv for each in movers)

    def forward(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (n, nv)."""
        found = [x.forward(q[:, a], v[:, b], tau[:, b]) for x, a, b in self._slices()]
        return found[0] if len(found) == 1 else np.concatenate(found, axis=1)

    def gradients(self, q: Vector, v: Vector, a: Vector, weights: Vector) -> Vector:
        """Return the gradients of weighted sums of the accelerations, shape (3, n, nv)."""
        found = np.empty((3, *weights.shape))
        for each, i, j in self._slices():
            found[:, :, j] = each.gradients(q[:, i], v[:, j], a[:, j], weights[:, j])
        return found

    def _slices(self) -> Iterator[tuple[MoverBatchDynamics, slice, slice]]:
        nq = nv = 0
        for each in self.movers:
            model = each.model
            yield each, slice(nq, nq + model.nq), slice(nv, nv + model.nv)
            nq, nv = nq + model.nq, nv + model.nv
