"""Backend and Simulation: a physics engine, and one running world of it.

The state has one convention for every engine, that of Pinocchio: robots in the world's order, in
each robot a floating base first (position x, y, z in m and quaternion x, y, z, w; velocity as the
base's twist in its own frame: linear in m/s, then angular in rad/s), then the joints in the order
of the model file's tree. Every joint of one degree of freedom is one number, continuous ones too.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from physx_core.world import World

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Layout:
    """Names and places of everything in the state; fixed when the simulation is built.

    Attributes:
        joints: Names of the joints of one degree of freedom, in the state's order. With several
            robots each name begins with the robot's name and ``/``.
        bodies: Names of the links, likewise.
        position_index: Place of each joint in the positions, by joint name.
        velocity_index: Place of each joint in velocities and torques, by joint name.
        nq: Length of the positions: 7 for each floating base and 1 for each joint.
        nv: Length of velocities and torques: 6 for each floating base and 1 for each joint.
        lower: Lower limits of the joints' positions, shape (joints,), in rad or m; -inf: none.
        upper: Upper limits, likewise.
        max_velocity: Limits of the joints' velocities, shape (joints,), in rad/s or m/s.
        max_torque: Limits of the joints' torques, shape (joints,), in N m or N.
    """

    joints: tuple[str, ...]
    bodies: tuple[str, ...]
    position_index: dict[str, int]
    velocity_index: dict[str, int]
    nq: int
    nv: int
    lower: Vector
    upper: Vector
    max_velocity: Vector
    max_torque: Vector


@dataclass(frozen=True)
class State:
    """A snapshot of a simulation; plain and picklable.

    Attributes:
        positions: Shape (nq,).
        velocities: Shape (nv,).
        torques: The held torques, shape (joints,).
        frame: Number of physics steps since the simulation was built.
    """

    positions: Vector
    velocities: Vector
    torques: Vector
    frame: int


class Backend(ABC):
    """A physics engine."""

    @abstractmethod
    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation of the world, at rest in its neutral configuration.

        Args:
            world: What to simulate.
            seed: Seed of what the engine draws at random, if it does.

        Raises:
            ModelError: A robot cannot be loaded; the message says why.
        """


class Simulation(ABC):
    """One running world. A context manager; after `close` every call raises `SimulationError`.

    Attributes:
        period: Length of one physics step, in s.
        layout: Names and places in the state.
        features: What this engine can do, for example ``forward_dynamics``.
    """

    period: float
    layout: Layout
    features: frozenset[str]

    @property
    @abstractmethod
    def frame(self) -> int:
        """Number of physics steps since the simulation was built."""

    @property
    def time(self) -> float:
        """Simulated time, in s."""
        return self.frame * self.period

    @abstractmethod
    def set_torques(self, torques: Vector) -> None:
        """Hold these torques until they are changed; the joints' limits cut them.

        Args:
            torques: Shape (joints,), in N m or N.

        Raises:
            SimulationError: The shape is wrong or a value is not finite.
        """

    @abstractmethod
    def step(self, n: int = 1) -> None:
        """Simulate n physics steps under the held torques.

        Raises:
            SimulationError: The state is no longer finite.
        """

    @abstractmethod
    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), written into `out` if it is given."""

    @abstractmethod
    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), written into `out` if it is given."""

    @abstractmethod
    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Put the world into a state; time goes on.

        Args:
            positions: Shape (nq,).
            velocities: Shape (nv,).

        Raises:
            SimulationError: A shape is wrong or a value is not finite.
        """

    @abstractmethod
    def snapshot(self) -> State:
        """Return everything that `restore` needs to go on exactly from here."""

    @abstractmethod
    def restore(self, state: State) -> None:
        """Go back to a snapshot."""

    @abstractmethod
    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of links in the world frame, shape (names, 7).

        Args:
            names: Names of the links; None: all of `layout.bodies`.
            positions: State to compute them for, shape (nq,); None: the present one.

        Returns:
            In each row x, y, z in m and quaternion x, y, z, w.

        Raises:
            SimulationError: There is no link of that name.
        """

    @abstractmethod
    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), that torques (nv,) cause in a state."""

    @abstractmethod
    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that cause accelerations (nv,) in a state."""

    @abstractmethod
    def close(self) -> None:
        """Free the world; calling it again does nothing."""

    def __enter__(self) -> Self:
        """Return the simulation itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the simulation."""
        self.close()
