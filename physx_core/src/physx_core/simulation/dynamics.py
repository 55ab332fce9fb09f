"""Dynamics: what is computed for any state of a world, whatever its present one is.

The convention of all states is that of `physx_core.simulation.layout`.
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
        features: What it can do: names of `physx_core.simulation.features.FEATURES`.
    """

    engine: str = ""
    layout: Layout
    features: frozenset[str]

    @abstractmethod
    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) cause in a state.

        Damping, springs and Coulomb friction of the joints act; contacts and limits do not. All
        joints are driven by torques here, whatever their mode. Accelerations are derivatives of
        the velocities, so a base's are in its own frame.
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

        Times the velocities it gives the point's linear velocity, then the body's angular velocity,
        both along the world's axes.

        Args:
            body: Name of the link or object.
            positions: Shape (nq,).
            point: In the body's frame, in m.
        """
        raise self._lacks("jacobian")

    def forward_dynamics_derivatives(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward_dynamics` by positions, velocities and torques.

        Returns:
            Three arrays of shape (nv, nv), rows are accelerations. Those by the positions are by a
            small motion along each velocity, so a base has six columns, not seven. Coulomb friction
            counts as constant.
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
            processes: How many processes share the rows at most, this one among them. The others
                start when they are first needed and end with the simulation. An engine that
                cannot share rows computes all of them in this process, with the same results.

        Raises:
            SimulationError: An array does not fit; or one of the processes ended.
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

        Row i is of ``weights[i] @ forward_dynamics(...)`` in a state where the torques, whatever
        they are, cause ``accelerations[i]``.

        Args:
            positions: Shape (n, nq); each row is a state.
            velocities: Shape (n, nv).
            accelerations: Shape (n, nv), as `forward_dynamics_batch` returned them.
            weights: Shape (n, nv).
            processes: As in `forward_dynamics_batch`.

        Returns:
            Gradients by positions, velocities and torques, shape (3, n, nv); those by the positions
            are by small motions, as in `forward_dynamics_derivatives`.

        Raises:
            SimulationError: An array does not fit; or one of the processes ended.
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
