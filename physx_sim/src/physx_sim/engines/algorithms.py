"""Algorithms: what an engine computes for a world in any state, not only its current one."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from physx_core import Closeable
from physx_core.typing import Vector


class Algorithms(Closeable):
    """Kinematics and dynamics of the robots and objects of a world.

    States follow the convention of `physx_sim.layout`; `RobotSimulation` has already
    validated them and normalized their quaternions. All results are new C-ordered float64 arrays,
    which ``torch.from_numpy`` accepts directly. Bodies are indices into `Layout.names`, so they may
    be static.

    Attributes:
        nq: Length of the positions.
        nv: Length of the velocities.
    """

    nq: int
    nv: int

    @abstractmethod
    def body_poses(self, q: Vector, bodies: Sequence[int]) -> Vector:
        """Return the poses of bodies, given as indices into `Layout.names`, shape (bodies, 7)."""

    @abstractmethod
    def motions(self, q: Vector, v: Vector, a: Vector, bodies: Sequence[int]) -> Vector:
        """Return the motions of bodies in the world frame, shape (bodies, 19).

        Args:
            q: Positions.
            v: Velocities.
            a: Accelerations.
            bodies: Indices into `Layout.names`.

        Returns:
            One row per body: pose (7), velocity (6), and acceleration (6) of its origin.
        """

    @abstractmethod
    def forward_dynamics(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,) and resistance."""

    @abstractmethod
    def inverse_dynamics(self, q: Vector, v: Vector, acceleration: Vector) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,) against resistance."""

    @abstractmethod
    def mass_matrix(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""

    @abstractmethod
    def jacobian(self, body: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point on a body, given by its index."""

    def forward_dynamics_derivatives(
        self, q: Vector, v: Vector, tau: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward_dynamics` w.r.t. positions, velocities, and torques.

        Feature `derivatives`.
        """
        raise NotImplementedError

    def forward_batch(self, q: Vector, v: Vector, tau: Vector, processes: int = 1) -> Vector:
        """Return `forward_dynamics` for many states, one per row, shape (n, nv).

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            tau: Torques, shape (n, nv).
            processes: Maximum number of processes that share the rows.
        """
        found = [self.forward_dynamics(*state) for state in zip(q, v, tau, strict=True)]
        return np.array(found, np.float64).reshape(-1, self.nv)

    def gradients_batch(
        self, q: Vector, v: Vector, a: Vector, weights: Vector, processes: int = 1
    ) -> Vector:
        """Return gradients of weighted sums of the accelerations, shape (3, n, nv).

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            a: Accelerations that result from the torques, shape (n, nv).
            weights: Shape (n, nv).
            processes: Maximum number of processes that share the rows.
        """
        found = np.empty((3, *weights.shape))
        for place, (q_i, v_i, a_i, weight) in enumerate(zip(q, v, a, weights, strict=True)):
            tau = self.inverse_dynamics(q_i, v_i, a_i)
            for out, matrix in zip(
                found, self.forward_dynamics_derivatives(q_i, v_i, tau), strict=True
            ):
                out[place] = weight @ matrix
        return found

    def close(self) -> None:
        """Release resources such as processes."""
