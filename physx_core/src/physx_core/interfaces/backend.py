"""Backend and Simulation: a physics engine, and one running world of it.

The convention of all states is that of `physx_core.interfaces.layout`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

import numpy as np

from physx_core.errors import FeatureNotSupportedError
from physx_core.interfaces.layout import (
    CONTACT,
    RAY_HIT,
    AppliedWrench,
    Layout,
    Part,
    Records,
    State,
    Vector,
)
from physx_core.interfaces.robots import RobotInfo
from physx_core.world import World, Wrench

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

FEATURES = {
    "accelerations": "accelerations of the last step",
    "actuators": "joint modes servo, velocity and position",
    "armature": "JointSettings.armature",
    "body_contacts": "contacts between things that both move",
    "contacts": "contacts with what does not move",
    "derivatives": "derivatives of the forward dynamics",
    "exact_restore": "restore goes on bit for bit",
    "forward_dynamics": "forward dynamics of any state",
    "hooks": "functions called at physics steps",
    "inverse_dynamics": "inverse dynamics of any state",
    "isotropic_friction": "friction that is the same in all directions",
    "jacobian": "Jacobians of links",
    "joint_friction": "Coulomb friction in joints",
    "joint_wrenches": "what joints carry, on the link behind: at its origin, along its axes",
    "limits": "limits of joints' positions and velocities stop them",
    "mass_matrix": "mass matrix of any state",
    "mesh_contacts": "meshes as collision shapes",
    "raycast": "rays",
    "restitution": "things bounce",
    "rk4": 'World(integrator="rk4")',
    "self_collisions": "Robot(self_collisions=True)",
    "springs": "springs and damping in joints",
    "wrenches": "forces from outside",
}
"""Every feature that a simulation's `features` may name, and what it means."""


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


class Simulation(ABC):
    """One running world. A context manager; after `close` every call raises `SimulationError`.

    A method whose feature is not in `features` raises `FeatureNotSupportedError`.

    Attributes:
        engine: Name of the engine.
        period: Length of one physics step, in s.
        layout: Names and places in the state.
        features: What this simulation can do: names of `FEATURES`.
    """

    engine: str = ""
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
            commands: Shape (joints,): torque, velocity or position, as each joint's mode says.

        Raises:
            SimulationError: The shape is wrong or a value is not finite.
        """

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
            In each row x, y, z in m and quaternion x, y, z, w.

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

    # Dynamics of any state ------------------------------------------------------------------

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
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> Vector:
        """Return `forward_dynamics` of many states, shape (n, nv); each row is a state.

        Args:
            positions: Shape (n, nq).
            velocities: Shape (n, nv).
            torques: Shape (n, nv).
        """
        states = zip(positions, velocities, torques, strict=True)
        found = [self.forward_dynamics(*state) for state in states]
        return np.array(found, np.float64).reshape(-1, self.layout.nv)

    def forward_dynamics_derivatives_batch(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector]:
        """Return accelerations of many states, and their derivatives.

        Args:
            positions: Shape (n, nq); each row is a state.
            velocities: Shape (n, nv).
            torques: Shape (n, nv).

        Returns:
            Accelerations, shape (n, nv), and the derivatives of `forward_dynamics_derivatives` by
            positions, velocities and torques, shape (3, n, nv, nv).
        """
        states = zip(positions, velocities, torques, strict=True)
        found = [self.forward_dynamics_derivatives(*state) for state in states]
        shape = (len(found), 3, self.layout.nv, self.layout.nv)
        derivatives = np.array(found, np.float64).reshape(shape).swapaxes(0, 1)
        return self.forward_dynamics_batch(positions, velocities, torques), derivatives

    # ----------------------------------------------------------------------------------------

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

    def _lacks(self, feature: str) -> FeatureNotSupportedError:
        return FeatureNotSupportedError(self.engine or type(self).__name__, feature, self.features)


Hook = Callable[[Simulation], None]
"""Function that is called with the simulation, before a physics step."""
