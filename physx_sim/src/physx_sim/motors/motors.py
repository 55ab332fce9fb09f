"""Motors of a simulation: commands in, joint torques out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from physx_core.errors import ConfigError
from physx_core.typing import Vector
from physx_sim.backend import Simulation
from physx_sim.description.world import World
from physx_sim.devices import as_slice, check_unique, places_of, steps_of
from physx_sim.errors import FeatureNotSupportedError, SimulationError
from physx_sim.motors.motor import Motor, armature_in
from physx_sim.motors.network import AddedTorques
from physx_sim.motors.shaft import Friction, Rotors, TorqueLimits, column
from physx_sim.vectors import overwrite


@dataclass(frozen=True)
class MotorState:
    """A snapshot of motors; plain and picklable.

    Attributes:
        commands: Shaft torques, shape (motors,), in N m.
        drives: Shaft torques held until the motors' next period, shape (motors,), in N m.
        others: Commands of all joints, 0 for those with motors, shape (joints,).
        torques: Torques on the motors' joints in the last step, shape (motors,), in N m or N.
        rotor_positions: Positions of rotors behind elastic gears, in rad or m at the joint.
        rotor_velocities: Velocities of these rotors, in rad/s or m/s at the joint.
        fresh: Whether they have not run since they were created or reset.
        histories: What networks have seen: torques and velocities, shape (networks, 2, samples).
        added: Torques that networks add, shape (networks,), in N m or N.
    """

    commands: Vector
    drives: Vector
    others: Vector
    torques: Vector
    rotor_positions: Vector
    rotor_velocities: Vector
    fresh: bool
    histories: Vector
    added: Vector


class Motors:
    """Motors on joints of a simulation: commands in, joint torques out before each physics step.

    Attached as a hook of the simulation, they run automatically and command all of its joints::

        motors = Motors(simulation, world, [Motor(joint="knee", max_torque=30.0)])
        motors.attach(simulation)
        motors.set_commands([12.0])
        simulation.step(10)

    Alternatively, call them before each single `step`. Attached motors with rigid gears and no
    friction run only at their periods and cost nothing in between. Motors keep no reference to the
    simulation and can be pickled. Call `reset` after `Simulation.set_state`, and their `snapshot`
    and `restore` along with the simulation's, so that elastic rotors stay with their joints.

    Attributes:
        motors: The motors, in the order of the commands.
        joints: Names of their joints, in the same order.
    """

    def __init__(self, simulation: Simulation, world: World, motors: Sequence[Motor]) -> None:
        """Attach motors to joints, with commands of 0.

        Args:
            simulation: The simulation whose joints they drive.
            world: The world that the simulation was built from.
            motors: At most one for each joint.

        Raises:
            ComponentNotFoundError: If the simulation has no joint with a given name.
            ConfigError: If two motors share a joint, a joint's mode is not ``"force"``, a period is
                not a multiple of the physics period, a gear is too stiff for that period, the world
                lacks a rotor's inertia, or a network cannot be read.
            FeatureNotSupportedError: If a rotor behind a rigid gear needs the feature ``armature``.
        """
        self.motors = tuple(motors)
        self.joints = tuple(motor.joint for motor in motors)
        layout, period = simulation.layout, simulation.period
        check_unique("motors on joint", self.joints)
        self._places = places_of("joint", self.joints, layout.joints)
        self._q = places_of("joint", self.joints, layout.position_index)
        self._v = places_of("joint", self.joints, layout.velocity_index)
        self._check(simulation, world)
        every = [
            steps_of(f'Motor of "{motor.joint}": period', motor.period, period) for motor in motors
        ]
        self._every = np.array(every)
        self._shared_every = every[0] if len(set(every)) == 1 else None
        self._reduction = column(motors, "reduction")
        self._limits, self._friction = TorqueLimits(motors), Friction(motors)
        self._joint_limit = layout.max_torque[self._places]
        self._elastic = np.flatnonzero([motor.stiffness is not None for motor in motors])
        elastic = [motor for motor in motors if motor.stiffness is not None]
        self._rotors = None
        if elastic:
            self._rotors = Rotors(elastic, period, self._joint_limit[self._elastic])
        self._networks = AddedTorques(motors, period)
        self._learned = len(self._networks.places) > 0
        self._reads = self._friction.acts or self._rotors is not None or self._learned
        self._geared = bool((self._reduction != 1).any()) or self._rotors is not None
        self._limited = bool(np.isfinite(self._joint_limit).any())
        self._hook_every = 1 if self._reads else int(np.gcd.reduce(self._every))
        self._commands, self._drives = np.zeros(len(motors)), np.zeros(len(motors))
        self._torques, self._nothing = np.zeros(len(motors)), np.zeros(0)
        self._fresh = True
        self._sent, self._span = simulation.commands(), as_slice(self._places)
        self.reset(simulation)

    def _check(self, simulation: Simulation, world: World) -> None:
        modes = simulation.layout.modes
        for motor, place in zip(self.motors, self._places, strict=True):
            if modes and modes[place] != "force":
                raise ConfigError(
                    f'The joint "{motor.joint}" has the mode "{modes[place]}"; a motor needs '
                    '"force".'
                )
            if motor.stiffness is not None or not motor.inertia:
                continue
            if "armature" not in simulation.features:
                raise FeatureNotSupportedError(
                    simulation.engine,
                    "armature",
                    simulation.features,
                    f'Give the motor of "{motor.joint}" a gear with stiffness, or no inertia.',
                )
            if armature_in(world, motor.joint) < motor.armature * (1 - 1e-9):
                raise ConfigError(
                    f'The inertia of the motor of "{motor.joint}" is missing from the world. Build '
                    "the simulation from with_rotors(world, motors), and pass that world here."
                )

    # Commands -------------------------------------------------------------------------------

    def set_commands(self, commands: ArrayLike) -> None:
        """Hold shaft torques; each motor applies its own at its next period.

        Args:
            commands: Shape (motors,), in N m.

        Raises:
            SimulationError: If the shape is wrong or a value is not finite.
        """
        overwrite("commands", self._commands, commands)

    def set_others(self, commands: ArrayLike) -> None:
        """Hold commands of joints without motors; initially, those at the motors' creation apply.

        Args:
            commands: For all joints, shape (joints,); entries of joints with motors are ignored.

        Raises:
            SimulationError: If the shape is wrong or a value is not finite.
        """
        overwrite("commands", self._sent, commands)
        self._sent[self._span] = self._torques

    @property
    def commands(self) -> Vector:
        """The held shaft torques, shape (motors,), in N m; a copy."""
        return self._commands.copy()

    @property
    def torques(self) -> Vector:
        """Torques on the joints in the last step, shape (motors,), in N m or N; a copy."""
        return self._torques.copy()

    @property
    def torques_view(self) -> Vector:
        """The same as `torques` without a copy: read-only, always the same memory."""
        found = self._torques.view()
        found.flags.writeable = False
        return found

    # Running --------------------------------------------------------------------------------

    def __call__(self, simulation: Simulation) -> None:
        """Set the torques for the next physics step; call this once before each step."""
        due = self._due(simulation.frame)
        if due is False and not self._reads:
            return
        velocities = joint_velocities = self._nothing
        if self._reads or self._limits.needs_velocity:
            joint_velocities = simulation.velocities()[self._v]
            velocities = joint_velocities * self._reduction
        if self._rotors is not None:
            elastic = self._elastic
            velocities[elastic] = self._rotors.velocities * self._reduction[elastic]
        if due is not False:
            drives = self._limits.cut(self._commands, velocities)
            np.copyto(self._drives, drives, where=due)
        torques = self._drives
        if self._friction.acts:
            torques = torques - self._friction.torques(velocities)
        if self._geared:
            torques = torques * self._reduction
        if self._rotors is not None:
            positions = simulation.positions()[self._q[self._elastic]]
            torques[self._elastic] = self._rotors.step(
                torques[self._elastic], positions, joint_velocities[self._elastic]
            )
        if self._learned:
            at = self._networks.places
            torques = torques.copy()
            torques[at] += self._networks.update(
                torques[at], joint_velocities[at], simulation.frame
            )
        self._send(simulation, torques)

    def _send(self, simulation: Simulation, torques: Vector) -> None:
        """Clip torques to the joints' limits; command them and the joints without motors."""
        if self._limited:  # elastic gears have already acted on the rotors
            torques = np.minimum(np.maximum(torques, -self._joint_limit), self._joint_limit)
        self._torques[:] = torques
        self._sent[self._span] = torques
        simulation.set_commands(self._sent)

    def _due(self, frame: int) -> Vector | bool:
        """Return which motors update their commands at a frame."""
        if self._fresh:
            self._fresh = False
            return True
        if self._shared_every is not None:
            return frame % self._shared_every == 0
        due: Vector = frame % self._every == 0
        return due if due.any() else False

    # State ----------------------------------------------------------------------------------

    def reset(self, simulation: Simulation) -> None:
        """Restart from the simulation's current state with commands of 0 and unloaded gears."""
        self._commands[:] = self._drives[:] = 0.0
        self._send(simulation, self._drives)
        self._fresh = True
        self._networks.reset()
        if self._rotors is not None:
            self._rotors.positions = simulation.positions()[self._q[self._elastic]]
            self._rotors.velocities = simulation.velocities()[self._v[self._elastic]]

    def snapshot(self) -> MotorState:
        """Return everything that `restore` needs to continue exactly from here."""
        rotors, none, others = self._rotors, np.zeros(0), self._sent.copy()
        others[self._span] = 0.0
        return MotorState(
            self._commands.copy(),
            self._drives.copy(),
            others,
            self._torques.copy(),
            none if rotors is None else rotors.positions.copy(),
            none if rotors is None else rotors.velocities.copy(),
            self._fresh,
            self._networks.history.copy(),
            self._networks.added.copy(),
        )

    def restore(self, state: MotorState) -> None:
        """Return to a snapshot.

        Raises:
            SimulationError: If the snapshot belongs to other motors.
        """
        own = self.snapshot()
        for name, value in vars(own).items():
            given: Any = getattr(state, name, None)
            if type(given) is not type(value) or np.shape(given) != np.shape(value):
                raise SimulationError(f"The snapshot is not of these motors: {name} differs.")
        self._commands[:], self._drives[:] = state.commands, state.drives
        self._torques[:], self._sent[:] = state.torques, state.others
        self._sent[self._span] = self._torques
        self._fresh = state.fresh
        self._networks.history[:], self._networks.added[:] = state.histories, state.added
        if self._rotors is not None:
            self._rotors.positions = state.rotor_positions.copy()
            self._rotors.velocities = state.rotor_velocities.copy()

    def attach(self, simulation: Simulation) -> Self:
        """Run before each of a simulation's physics steps from now on; return these motors."""
        simulation.add_hook(self, self._hook_every)
        return self
