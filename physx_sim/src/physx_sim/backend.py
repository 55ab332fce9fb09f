"""Backend, a physics engine, and Simulation, a world running in it.

States follow the convention of `physx_sim.layout`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from physx_core import Closeable
from physx_core.typing import Records, Vector
from physx_sim.derivatives import StepDerivatives
from physx_sim.description.attachment import Attachment
from physx_sim.description.body_settings import BodySettings
from physx_sim.description.ground import HeightField
from physx_sim.description.world import World
from physx_sim.description.wrench import Wrench
from physx_sim.errors import FeatureNotSupportedError
from physx_sim.layout import Layout, State
from physx_sim.sensors.sensor import Camera


@dataclass(frozen=True)
class RobotInfo:
    """A robot that a world may refer to by name instead of by file, as in ``Robot("cartpole")``.

    Attributes:
        name: Name of the robot.
        path: Its model file.
        joints: Number of its joints' degrees of freedom; a floating base has 6 more.
        mass: Total mass of its links, in kg.
        collisions: Kind of its collision shapes: ``"primitives"``, ``"meshes"``, ``"both"`` or
            ``"none"``.
        warnings: Caveats about using it.
        error: Reason why it cannot be loaded; empty if it can. Otherwise the other values are 0
            and ``"none"``.
    """

    name: str
    path: Path
    joints: int = 0
    mass: float = 0.0
    collisions: str = "none"
    warnings: tuple[str, ...] = ()
    error: str = ""


class Backend(ABC):
    """A physics engine."""

    @abstractmethod
    def build(self, world: World, seed: int | None = None) -> Simulation:
        """Build a simulation of a world, at rest in its neutral configuration.

        Args:
            world: The world to simulate.
            seed: Seed of the engine's random numbers, if it draws any.

        Raises:
            ModelError: If a robot or mesh cannot be loaded; the message gives the reason.
            FeatureNotSupportedError: If the world needs a feature that the engine does not have.
        """

    def robots(self) -> Sequence[RobotInfo]:
        """Return the robots that a world may refer to by name; none unless overridden."""
        return ()

    def robot_path(self, name: str) -> Path | None:
        """Return the model file of a named robot, or None if there is none.

        Override this where a lookup is faster than describing all robots.
        """
        return next((info.path for info in self.robots() if info.name == name), None)


class Simulation(Closeable):
    """A running world; a context manager. After `close`, every call raises `SimulationError`.

    A method whose feature is not in `features` raises `FeatureNotSupportedError`.

    Attributes:
        engine: Name of the engine.
        period: Length of one physics step, in s.
        layout: Names and indices in the state.
        features: Features of this simulation: names from `FEATURES`.
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
        """Hold these torques until they are changed, clipped to the joints' limits.

        Args:
            torques: Shape (joints,), in N m or N.

        Raises:
            SimulationError: If the shape is wrong, a value is not finite, or a joint's mode is not
                ``"force"``.
        """

    @abstractmethod
    def set_commands(self, commands: Vector) -> None:
        """Hold these commands until they are changed, clipped to the joints' limits.

        Args:
            commands: Shape (joints,): torque, velocity, or position, depending on each joint's
                mode; copied.

        Raises:
            SimulationError: If the shape is wrong or a value is not finite.
        """

    def commands(self) -> Vector:
        """Return the held commands, clipped to the joints' limits, shape (joints,)."""
        return self.snapshot().commands

    @abstractmethod
    def step(self, n: int = 1) -> None:
        """Simulate n physics steps under the held commands.

        Raises:
            SimulationError: If the state is no longer finite, or a hook calls `step`.
        """

    def step_with_derivatives(self, n: int = 1, *, compare_sides: bool = False) -> StepDerivatives:
        """Simulate n physics steps like `step`; return how the result depends on what was before.

        Impacts take place at the end of steps, here as in differences of simulations, so where
        something hits, the derivatives are those of the steps, not of the motion that they
        approximate.

        Args:
            n: Number of steps, under the held commands.
            compare_sides: Whether to determine `StepDerivatives.asymmetry`, by `n` steps from each
                of two states nearby; the warm start is then discarded as in `snapshot`.

        Raises:
            SimulationError: If `n` is invalid, the state is no longer finite, or one of the steps
                has no derivatives; the message names the reason. The simulation is then after this
                step.
        """
        raise self._lacks("step_derivatives")

    def add_hook(self, hook: Hook, every: int = 1) -> None:
        """Call a function before the physics steps whose frame is a multiple of `every`.

        It may read everything and set commands and wrenches. Hooks are called in the order in which
        they were added. Without hooks, `step` has no extra cost. Snapshots do not include hooks.
        """
        raise self._lacks("hooks")

    def remove_hook(self, hook: Hook) -> None:
        """Remove a hook.

        Raises:
            SimulationError: If the function is not a hook of this simulation.
        """
        raise self._lacks("hooks")

    def apply_wrench(self, wrench: Wrench) -> int:
        """Apply a wrench to a body from now on; return its number for `remove_wrench`.

        Raises:
            SimulationError: If there is no body with that name, or it cannot move.
        """
        raise self._lacks("wrenches")

    def remove_wrench(self, number: int) -> None:
        """Remove a wrench.

        Raises:
            SimulationError: If no wrench with that number is active.
        """
        raise self._lacks("wrenches")

    @property
    def gravity(self) -> Vector:
        """Acceleration of free fall in the world frame, in m/s², shape (3,); a copy."""
        raise self._lacks("gravity")

    def set_gravity(self, gravity: Sequence[float]) -> None:
        """Change the acceleration of free fall from now on; snapshots contain it.

        Args:
            gravity: In the world frame, in m/s², shape (3,).

        Raises:
            SimulationError: If it is not three finite numbers.
        """
        raise self._lacks("gravity")

    def set_body(self, name: str, settings: BodySettings) -> None:
        """Change a body from now on; snapshots contain it.

        Masses, friction, hidden objects: feature `changes`. Static objects that move, and surfaces
        that do: feature `moving_statics`.

        Args:
            name: Name of a link, object, or static body, as in `Layout.names`.
            settings: What to change; the rest stays.

        Raises:
            SimulationError: If there is no body with that name, it does not have what changes, or
                it is attached and would be hidden or moved.
        """
        raise self._lacks("changes")

    def body_settings(self, name: str) -> BodySettings:
        """Return what `set_body` changed about a body, with its current pose if that changes.

        Raises:
            SimulationError: If there is no body with that name.
        """
        raise self._lacks("changes")

    def set_ground(self, field: HeightField) -> None:
        """Replace a height field by another one with as many heights; snapshots contain it.

        Raises:
            SimulationError: If it is no height field, or the ground is none or has others.
        """
        raise self._lacks("changes")

    def attach(self, attachment: Attachment) -> int:
        """Hold two bodies together from now on; return the attachment's number for `detach`.

        What the attachment leaves open is where the bodies are now. Bodies that are elsewhere than
        it says are pulled there within some steps.

        Raises:
            SimulationError: If there is no body with one of the names, neither can move, or one is
                hidden or a static body that moves.
        """
        raise self._lacks("attachments")

    def detach(self, number: int) -> None:
        """End an attachment. Those of a world and of its robots have the first numbers, from 0.

        Raises:
            SimulationError: If no attachment with that number is active.
        """
        raise self._lacks("attachments")

    # State ----------------------------------------------------------------------------------

    @abstractmethod
    def positions(self, out: Vector | None = None) -> Vector:
        """Return the positions, shape (nq,), copied to `out` if given."""

    @abstractmethod
    def velocities(self, out: Vector | None = None) -> Vector:
        """Return the velocities, shape (nv,), copied to `out` if given."""

    @abstractmethod
    def set_state(self, positions: Vector, velocities: Vector) -> None:
        """Set the state without resetting the time. There are no contacts until the next step.

        Args:
            positions: Shape (nq,).
            velocities: Shape (nv,).

        Raises:
            SimulationError: If a shape is wrong or a value is not finite.
        """

    @abstractmethod
    def snapshot(self) -> State:
        """Return everything that `restore` needs to continue exactly from here.

        An engine that warm-starts each step with impulses or contacts of the last one discards them
        here, as it does in `restore` and `set_state`. The state alone then determines what follows,
        bit-identical here and wherever the snapshot is restored. It differs from what would have
        followed without the snapshot, within the accuracy of the engine's solver.
        """

    @abstractmethod
    def restore(self, state: State) -> None:
        """Return to a snapshot.

        Raises:
            SimulationError: If the snapshot is of a world with a different layout.
        """

    # Measurements ---------------------------------------------------------------------------

    def accelerations(self) -> Vector:
        """Return the velocity change in the last step divided by the period, shape (nv,).

        Uses the convention of the velocities and includes the effects of constraints. 0 before the
        first step and after `set_state`; after `restore` those before the snapshot.
        """
        raise self._lacks("accelerations")

    def contacts(self) -> Records:
        """Return the contacts of the last physics step as a new array of `CONTACT` records.

        After `restore`, those of the last step before the snapshot.
        """
        raise self._lacks("contacts")

    def joint_wrenches(self) -> Vector:
        """Return the joint reactions in the last step, shape (joints, 6): in N, then in N m."""
        raise self._lacks("joint_wrenches")

    def link_wrenches(self, names: Sequence[str]) -> Vector:
        """Return the reactions of the joints that lead to links, as `joint_wrenches`.

        Args:
            names: Names of links, as in `Layout.bodies`. Their joints may be fixed; that of the
                root link of a robot with a fixed base holds the whole robot.

        Returns:
            Per row, the force in N, then the torque in N m, on the link, at its origin, in its
            frame, shape (names, 6).

        Raises:
            SimulationError: If there is no link with one of these names, or no joint leads to it.
        """
        raise self._lacks("joint_wrenches")

    def raycast(self, begins: Vector, ends: Vector, ignored: Sequence[str] = ()) -> Records:
        """Return the first hit of each ray as an array of `RAY_HIT` records.

        A ray hits the collision shapes and the ground that it enters from outside.

        Args:
            begins: Start points of the rays, shape (n, 3), in m, in the world frame.
            ends: End points of the rays, in the same form.
            ignored: Names of bodies that rays pass.

        Raises:
            SimulationError: If a shape is wrong, a number is not finite, or there is no body with
                one of these names.
        """
        raise self._lacks("raycast")

    def take_images(self, camera: Camera) -> dict[str, Vector]:
        """Return the images of a camera by their names, in the present state.

        Args:
            camera: The camera; its period and errors have no effect.

        Raises:
            SimulationError: If there is no body with one of its names, or nothing can draw here.
        """
        raise self._lacks("cameras")

    @abstractmethod
    def body_poses(
        self, names: Sequence[str] | None = None, positions: Vector | None = None
    ) -> Vector:
        """Return the poses of links and objects in the world frame, shape (names, 7).

        Args:
            names: Body names, static ones included; None: all of `layout.bodies`.
            positions: Shape (nq,); None: the current ones.

        Returns:
            Per row, x, y, z in m and quaternion x, y, z, w, with w not negative.

        Raises:
            SimulationError: If there is no body with one of these names.
        """

    @abstractmethod
    def body_velocities(
        self,
        names: Sequence[str] | None = None,
        positions: Vector | None = None,
        velocities: Vector | None = None,
    ) -> Vector:
        """Return the velocities of the origins of links and objects, shape (names, 6).

        Args:
            names: Body names, static ones included; None: all of `layout.bodies`.
            positions: Shape (nq,); None: the current ones.
            velocities: Shape (nv,); None: the current ones.

        Returns:
            Per row, the linear velocity in m/s, then the angular velocity in rad/s, both in the
            world frame.

        Raises:
            SimulationError: If there is no body with one of these names.
        """

    def body_accelerations(self, names: Sequence[str] | None = None) -> Vector:
        """Return the accelerations of the origins of links and objects, shape (names, 6).

        They follow from `accelerations` and the current state; before the first step they contain
        only centripetal and Coriolis terms.

        Args:
            names: Body names, static ones included; None: all of `layout.bodies`.

        Returns:
            Per row, the linear acceleration in m/s², then the angular acceleration in rad/s², both
            in the world frame.

        Raises:
            SimulationError: If there is no body with one of these names.
        """
        raise self._lacks("accelerations")

    def body_motions(self, names: Sequence[str] | None = None) -> Vector:
        """Return poses, velocities, and accelerations of links and objects, shape (names, 19).

        Each row holds a pose (7) as from `body_poses`, a velocity (6) as from `body_velocities`,
        and an acceleration (6) as from `body_accelerations`; faster than three calls.
        """
        found = self.body_poses(names), self.body_velocities(names), self.body_accelerations(names)
        return np.concatenate(found, axis=1)

    def reach(self, name: str, direction: Vector, positions: Vector | None = None) -> float:
        """Return how far a robot's or object's collision shapes extend along a direction.

        Args:
            name: Name of the robot or object, as in `layout.parts`.
            direction: Unit vector, shape (3,), in the world frame.
            positions: Shape (nq,); None: the current ones.

        Returns:
            The largest dot product of the direction with a point of the shapes, in m; -inf if there
            are no collision shapes.

        Raises:
            SimulationError: If there is no moving robot or object with that name.
        """
        raise self._lacks("contacts")

    # Dynamics of any state, not only the current one ----------------------------------------

    @abstractmethod
    def forward_dynamics(self, positions: Vector, velocities: Vector, torques: Vector) -> Vector:
        """Return the accelerations, shape (nv,), caused by torques (nv,) in a state.

        Joint damping, springs, and Coulomb friction are included; contacts, limits, attachments,
        and couplings of joints, such as `Mimic`, are not. All joints are driven by torques here,
        regardless of their mode. Accelerations are the time derivatives of the velocities, so those
        of a base are in its own frame.
        """

    @abstractmethod
    def inverse_dynamics(
        self, positions: Vector, velocities: Vector, accelerations: Vector
    ) -> Vector:
        """Return the torques, shape (nv,), that produce accelerations (nv,) in a state."""

    def mass_matrix(self, positions: Vector) -> Vector:
        """Return the mass matrix, shape (nv, nv)."""
        raise self._lacks("mass_matrix")

    def jacobian(
        self, body: str, positions: Vector, point: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> Vector:
        """Return the Jacobian, shape (6, nv), of a point on a link or object.

        It maps the velocities to the point's linear and the body's angular velocity, both in the
        world frame.

        Args:
            body: Name of the link or object.
            positions: Shape (nq,).
            point: In the body's frame, in m.
        """
        raise self._lacks("jacobian")

    def forward_dynamics_derivatives(
        self, positions: Vector, velocities: Vector, torques: Vector
    ) -> tuple[Vector, Vector, Vector]:
        """Return derivatives of `forward_dynamics` w.r.t. positions, velocities, and torques.

        Returns:
            Three arrays of shape (nv, nv), whose rows are accelerations. Derivatives w.r.t.
            positions are taken along small motions in velocity space, so a base has six columns,
            not seven. Coulomb friction is treated as constant.
        """
        raise self._lacks("derivatives")

    def forward_dynamics_batch(
        self, positions: Vector, velocities: Vector, torques: Vector, *, processes: int = 1
    ) -> Vector:
        """Return `forward_dynamics` for many states, one per row, shape (n, nv).

        Args:
            positions: Shape (n, nq).
            velocities: Shape (n, nv).
            torques: Shape (n, nv).
            processes: Maximum number of processes that share the rows, including this one. The
                others start on first use and end with the simulation. An engine without parallel
                batches computes all rows in this process, with the same results.

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
        """Return gradients of weighted sums of `forward_dynamics` for many states.

        Row i is the gradient of ``weights[i] @ forward_dynamics(...)`` in the state whose torques
        cause ``accelerations[i]``.

        Args:
            positions: Shape (n, nq); each row is a state.
            velocities: Shape (n, nv).
            accelerations: Shape (n, nv), as `forward_dynamics_batch` returned them.
            weights: Shape (n, nv).
            processes: As in `forward_dynamics_batch`.

        Returns:
            Gradients w.r.t. positions, velocities, and torques, shape (3, n, nv); those w.r.t.
            positions are taken along small motions, as in `forward_dynamics_derivatives`.

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

    # ----------------------------------------------------------------------------------------

    def _lacks(self, feature: str) -> FeatureNotSupportedError:
        return FeatureNotSupportedError(self.engine or type(self).__name__, feature, self.features)

    @abstractmethod
    def close(self) -> None:
        """Free the world; further calls do nothing."""


Hook = Callable[[Simulation], None]
"""Function called with the simulation before a physics step."""
