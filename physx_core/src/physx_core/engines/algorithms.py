"""Algorithms: what an engine computes for a world in any state, whatever the present one is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np

from physx_core.closeable import Closeable
from physx_core.typing import Vector


class Algorithms(Closeable):
    """Kinematics and dynamics of the robots and objects of a world.

    States follow the convention of `physx_core.simulation.layout`; `RobotSimulation` has validated
    them, and scaled quaternions to length 1. All results are new arrays of float64 in C order,
    which ``torch.from_numpy`` accepts as they are. Bodies are places in `Layout.names`, so static
    things are among them.

    Attributes:
        nq: Length of the positions.
        nv: Length of the velocities.
    """

    nq: int
    nv: int

    @abstractmethod
    def body_poses(self, q: Vector, bodies: Sequence[int]) -> Vector:
        """Return the poses of bodies, shape (bodies, 7), by their places in `Layout.names`."""

    @abstractmethod
    def motions(self, q: Vector, v: Vector, a: Vector, bodies: Sequence[int]) -> Vector:
        """Return the motions of bodies, shape (bodies, 19), along the world's axes.

        Args:
            q: Positions.
            v: Velocities.
            a: Accelerations.
            bodies: Their places in `Layout.names`.

        Returns:
            In each row the pose (7), velocity (6), and acceleration (6) of the body's origin.
        """

    @abstractmethod
    def forward_dynamics(self, q: Vector, v: Vector, tau: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) and resistance cause."""

    @abstractmethod
    def inverse_dynamics(self, q: Vector, v: Vector, acceleration: Vector) -> Vector:
        """Return the torques, shape (nv,), that cause accelerations (nv,) against resistance."""

    @abstractmethod
    def mass_matrix(self, q: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""

    @abstractmethod
    def jacobian(self, body: int, q: Vector, point: Vector) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point of a body, by its place in the layout."""

    def joint_wrenches(
        self, q: Vector, v: Vector, a: Vector, outer: Mapping[int, Sequence[float]]
    ) -> Vector:
        """Return the reactions of joints in a state, shape (joints, 6); feature `joint_wrenches`.

        Args:
            q: Positions.
            v: Velocities.
            a: Accelerations.
            outer: External wrenches on bodies, by their places: force, then torque about the body's
                origin, 6 numbers along the world's axes.
        """
        raise NotImplementedError

    def forward_dynamics_derivatives(
        self, q: Vector, v: Vector, tau: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return the derivatives of `forward_dynamics` by positions, velocities, and torques.

        Feature `derivatives`.
        """
        raise NotImplementedError

    def forward_batch(self, q: Vector, v: Vector, tau: Vector, processes: int = 1) -> Vector:
        """Return `forward_dynamics` of many states, shape (n, nv); each row is a state.

        Args:
            q: Positions, shape (n, nq).
            v: Velocities, shape (n, nv).
            tau: Torques, shape (n, nv).
            processes: Most processes that may share the rows.
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
            a: Accelerations that the torques cause, shape (n, nv).
            weights: Shape (n, nv).
            processes: Most processes that may share the rows.
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
        """Free what the algorithms hold, such as processes."""
