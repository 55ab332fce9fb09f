"""Dynamics of a world, computed for any state, independent of the present one.

States follow the convention of `physx_core.simulation.layout`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from physx_core.errors import FeatureNotSupportedError
from physx_core.simulation.layout import Layout
from physx_core.typing import Vector


class Dynamics(ABC):
    """The dynamics of a world; a part of `Simulation`.

    Attributes:
        engine: Name of the engine.
        layout: Names and places in the state.
        features: Its features: names of `physx_core.simulation.FEATURES`.
    """

    engine: str = ""
    layout: Layout
    features: frozenset[str]

    @abstractmethod
    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) cause in a state.

        Damping, springs, and Coulomb friction of the joints act; contacts and limits do not. All
        joints are driven by torques here, whatever their mode. Accelerations are the derivatives of
        the velocities, so those of a base are in its own frame.
        """

    @abstractmethod
    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that cause accelerations (nv,) in a state."""

    def mass_matrix(self, positions: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        raise self._lacks("mass_matrix")

    def jacobian(
        self, body: str, positions: Vector, point: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point of a link or object.

        It maps the velocities to the point's linear and the body's angular velocity, both along the
        world's axes.

        Args:
            body: Name of the link or object.
            positions: Shape (nq,).
            point: In the body's frame, in m.
        """
        raise self._lacks("jacobian")

    def forward_dynamics_derivatives(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward_dynamics` by positions, velocities, and torques.

        Returns:
            Three arrays of shape (nv, nv), whose rows are accelerations. Derivatives by the
            positions are by small motions along the velocities, so a base has six columns, not
            seven. Coulomb friction is treated as constant.
        """
        raise self._lacks("derivatives")

    def forward_dynamics_batch(
        self, positions: Vector, velocities: Vector, torques: Vector, *, processes: int = 1
    ) -> Vector:
        """Return `forward_dynamics` of many states, shape (n, nv); each row is a state.

        Args:
            positions: Shape (n, nq).
            velocities: Shape (n, nv).
            torques: Shape (n, nv).
            processes: Largest number of processes that share the rows, including this one. The
                others start when they are first needed and end with the simulation. An engine
                without them computes all rows in this process, with the same results.

        Raises:
            SimulationError: If an array has the wrong shape, or one of the processes ended.
        """
        states = zip(positions, velocities, torques, strict=True)
        found = [self.forward_dynamics(*state) for state in states]
        return np.array(found, np.float64).reshape(-1, self.layout.nv)

    def forward_dynamics_gradients_batch(
        self,
        positions: Vector,
        velocities: Vector,
        accelerations: Vector,
        weights: Vector,
        *,
        processes: int = 1,
    ) -> Vector:
        """Return gradients of weighted sums of `forward_dynamics` of many states.

        Row i belongs to ``weights[i] @ forward_dynamics(...)`` in the state whose torques cause
        ``accelerations[i]``.

        Args:
            positions: Shape (n, nq); each row is a state.
            velocities: Shape (n, nv).
            accelerations: Shape (n, nv), as `forward_dynamics_batch` returned them.
            weights: Shape (n, nv).
            processes: As in `forward_dynamics_batch`.

        Returns:
            Gradients by positions, velocities, and torques, shape (3, n, nv); those by the
            positions are by small motions, as in `forward_dynamics_derivatives`.

        Raises:
            SimulationError: If an array has the wrong shape, or one of the processes ended.
        """
        found = np.empty((3, len(weights), self.layout.nv))
        rows = zip(positions, velocities, accelerations, weights, strict=True)
        for number, (q, v, a, weight) in enumerate(rows):
            torques = self.inverse_dynamics(q, v, a)
            for out, matrix in zip(
                found, self.forward_dynamics_derivatives(q, v, torques), strict=True
            ):
                out[number] = weight @ matrix
        return found

    def _lacks(self, feature: str) -> FeatureNotSupportedError:
        return FeatureNotSupportedError(self.engine or type(self).__name__, feature, self.features)
