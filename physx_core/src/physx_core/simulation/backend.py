"""Backend and Simulation: a physics engine, and one running world of it.

The convention of all states is that of `physx_core.simulation.layout`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np

from physx_core.closeable import Closeable
from physx_core.simulation.description import World, Wrench
from physx_core.simulation.dynamics import Dynamics
from physx_core.simulation.features import FEATURES
from physx_core.simulation.layout import CONTACT, RAY_HIT, AppliedWrench, Layout, Part, State
from physx_core.simulation.robot_info import RobotInfo
from physx_core.typing import Records, Vector

__all__ = [
    "CONTACT",
    "FEATURES",
    "RAY_HIT",
    "AppliedWrench",
    "Backend",
    "Hook",
    "Layout",
    "Part",
    "Records",
    "RobotInfo",
    "Simulation",
    "State",
    "Vector",
]


class Backend(ABC):
    """A physics engine."""

    @abstractmethod
    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation of the world, at rest in its neutral configuration.

        Args:
            world: What to simulate.
            seed: Seed of what the engine draws at random, if it does.

        Raises:
            ModelError: A robot or mesh cannot be loaded; the message says why.
            FeatureNotSupportedError: The world asks for what the engine does not have.
        """

    def robots(self) -> Sequence[RobotInfo]:
        """Return the robots that a world may name instead of a file; none unless overridden."""
        return ()


class Simulation(Dynamics, Closeable):
    """One running world. A context manager; after `close` every call raises `SimulationError`.

    A method whose feature is not in `features` raises `FeatureNotSupportedError`.

    Attributes:
        engine: Name of the engine.
        period: Length of one physics step, in s.
        layout: Names and places in the state.
        features: What this simulation can do: names of `FEATURES`.
    """

    period: float

    @property
    @abstractmethod
    def frame(self) -> int:
        """Number of physics steps since the simulation was built."""

    @property
    def time(self) -> float:
        """Simulated time, in s."""
        return self.frame * self.period

    # Running --------------------------------------------------------------------------------

    @abstractmethod
    def set_torques(self, torques: Vector) -> None:
        """Hold these torques until they are changed; the joints' limits cut them.

        Args:
            torques: Shape (joints,), in N m or N.

        Raises:
            SimulationError: The shape is wrong, a value is not finite, or a joint's mode is not
                ``"force"``.
        """

    @abstractmethod
    def set_commands(self, commands: Vector) -> None:
        """Hold these commands until they are changed; the joints' limits cut them.

        Args:
            commands: Shape (joints,): torque, velocity or position, as each joint's mode says; it
                is copied.

        Raises:
            SimulationError: The shape is wrong or a value is not finite.
        """

    def commands(self) -> Vector:
        """Return the held commands as the joints' limits cut them, shape (joints,)."""
        return self.snapshot().commands

    @abstractmethod
    def step(self, n: int = 1) -> None:
        """Simulate n physics steps under the held commands.

        Raises:
            SimulationError: The state is no longer finite, or a hook calls `step`.
        """

    def add_hook(self, hook: Hook, every: int = 1) -> None:
        """Call a function before the physics steps whose frame is a multiple of `every`.

        It may read everything and set commands and wrenches. Hooks are called in the order in which
        they were added. They cost their time at every step; without any `step` costs nothing more.
        Snapshots do not hold them.
        """
        raise self._lacks("hooks")

    def remove_hook(self, hook: Hook) -> None:
        """Call a function no longer.

        Raises:
            SimulationError: It is not called.
        """
        raise self._lacks("hooks")

    def apply_wrench(self, wrench: Wrench) -> int:
        """Let a force act on a body from now on; return its number for `remove_wrench`.

        Raises:
            SimulationError: There is no body of that name, or it cannot move.
        """
        raise self._lacks("wrenches")

    def remove_wrench(self, number: int) -> None:
        """End a wrench.

        Raises:
            SimulationError: None of that number acts.
        """
        raise self._lacks("wrenches")

    # State ----------------------------------------------------------------------------------

    @abstractmethod
    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), written into `out` if it is given."""

    @abstractmethod
    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), written into `out` if it is given."""

    @abstractmethod
    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Put the world into a state; time goes on. There are no contacts until the next step.

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
        """Go back to a snapshot.

        Raises:
            SimulationError: It is of a world with another layout.
        """

    # What can be measured -------------------------------------------------------------------

    def accelerations(self) -> Vector:
        """Return the change of the velocities in the last step by the period, shape (nv,).

        In the convention of the velocities; constraints are part of it. 0 before the first step,
        and after `set_state` and `restore`.
        """
        raise self._lacks("accelerations")

    def contacts(self) -> Records:
        """Return the contacts of the last physics step: an array of `CONTACT` records, a copy."""
        raise self._lacks("contacts")

    def joint_wrenches(self) -> Vector:
        """Return what the joints carried last, shape (joints, 6): force in N, torque in N m."""
        raise self._lacks("joint_wrenches")

    def raycast(self, begins: Vector, ends: Vector) -> Records:
        """Return what rays meet first: an array of `RAY_HIT` records.

        Args:
            begins: Where the rays begin, shape (n, 3), in m, in the world frame.
            ends: Where they end, likewise.
        """
        raise self._lacks("raycast")

    @abstractmethod
    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of links and objects in the world frame, shape (names, 7).

        Args:
            names: Their names, static ones too; None: all of `layout.bodies`.
            positions: State to compute them for, shape (nq,); None: the present one.

        Returns:
            In each row x, y, z in m and quaternion x, y, z, w, with w not negative.

        Raises:
            SimulationError: There is no body of that name.
        """

    @abstractmethod
    def body_velocities(
        self,
        names: Sequence[str] | None = None,
        positions: Vector | None = None,
        velocities: Vector | None = None,
    ) -> Vector:
        """Return the velocities of links' and objects' origins, shape (names, 6).

        Args:
            names: Their names, static ones too; None: all of `layout.bodies`.
            positions: State to compute them for, shape (nq,); None: the present one.
            velocities: Likewise, shape (nv,).

        Returns:
            In each row the linear velocity in m/s, then the angular one in rad/s, both along the
            world's axes.

        Raises:
            SimulationError: There is no body of that name.
        """

    def body_accelerations(self, names: Sequence[str] | None = None) -> Vector:
        """Return the accelerations of links' and objects' origins, shape (names, 6).

        Those of `accelerations`, in the present state: 0 before the first step, but for what the
        motion itself makes of them.

        Args:
            names: Their names, static ones too; None: all of `layout.bodies`.

        Returns:
            In each row the linear acceleration in m/s², then the angular one in rad/s², both along
            the world's axes.

        Raises:
            SimulationError: There is no body of that name.
        """
        raise self._lacks("accelerations")

    def body_motions(self, names: Sequence[str] | None = None) -> Vector:
        """Return all of how links and objects move at present, shape (names, 19).

        One call costs less than the three whose results it joins: a pose (7) as `body_poses` has
        it, a velocity (6) as `body_velocities`, an acceleration (6) as `body_accelerations`.
        """
        found = self.body_poses(names), self.body_velocities(names), self.body_accelerations(names)
        return np.concatenate(found, axis=1)

    def reach(self, name: str, direction: Vector, positions: Vector | None = None) -> float:
        """Return how far the collision shapes of a robot or object reach along a direction.

        Args:
            name: Of the robot or object, as in `layout.parts`.
            direction: Shape (3,), of length 1, in the world frame.
            positions: State to compute it for, shape (nq,); None: the present one.

        Returns:
            The largest product of the direction with a point of the shapes, in m; -inf where
            nothing of it can be touched.

        Raises:
            SimulationError: There is nothing of that name that moves.
        """
        raise self._lacks("contacts")

    # ----------------------------------------------------------------------------------------

    @abstractmethod
    def close(self) -> None:
        """Free the world; calling it again does nothing."""


Hook = Callable[[Simulation], None]
"""Function that is called with the simulation, before a physics step."""
