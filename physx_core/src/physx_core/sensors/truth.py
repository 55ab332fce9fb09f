"""What sensors would measure if they were perfect: one class for each kind, for all of its kind.

Each returns its sensors' components, shape (sensors, width), from nothing but the contract of
`Simulation`, so that they are the same on every engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from physx_core.devices import places_of
from physx_core.errors import ConfigError, FeatureNotSupportedError
from physx_core.interfaces.backend import Layout, Simulation, Vector
from physx_core.sensors.attitudes import cross, from_rotation_vectors, product, turned, turned_back
from physx_core.sensors.description import (
    ContactSensor,
    EffortSensor,
    Encoder,
    ForceTorqueSensor,
    Imu,
    Sensor,
)
from physx_core.world import World

_STRIDE = 6e-6
"""Share of the motion of 1 s over which velocities are differentiated: third root of epsilon."""


class Truth(Protocol):
    """Measures all sensors of one kind without errors."""

    def measure(self, simulation: Simulation) -> Vector:
        """Return the components, shape (sensors, width)."""


class EncoderTruth:
    """Positions and velocities of joints."""

    def __init__(self, sensors: Sequence[Encoder], simulation: Simulation) -> None:
        joints = [sensor.joint for sensor in sensors]
        self._q = places_of("joint", joints, simulation.layout.position_index)
        self._v = places_of("joint", joints, simulation.layout.velocity_index)
        self._reduction = np.array([sensor.reduction for sensor in sensors])

    def measure(self, simulation: Simulation) -> Vector:
        """Return position and velocity."""
        found = np.empty((len(self._q), 2))
        found[:, 0] = simulation.positions()[self._q] * self._reduction
        found[:, 1] = simulation.velocities()[self._v] * self._reduction
        return found


class ImuTruth:
    """Orientation, angular velocity and acceleration of places on bodies."""

    def __init__(self, sensors: Sequence[Imu], simulation: Simulation, world: World) -> None:
        _needs("accelerations", simulation, "An Imu")
        layout = simulation.layout
        names = [sensor.body for sensor in sensors]
        places = places_of("body", names, layout.names)
        bases = {part.bodies.start: part for part in layout.parts.values() if part.floating}
        self._on_base = np.array([place in bases for place in places.tolist()])
        mine = [bases[place] for place in places[self._on_base].tolist()]
        self._attitudes = np.array([part.positions.start for part in mine], np.intp)[:, None]
        self._attitudes = self._attitudes + np.arange(3, 7)
        self._twists = np.array([part.velocities.start for part in mine], np.intp)[:, None]
        self._bodies = [name for name, base in zip(names, self._on_base, strict=True) if not base]
        self._position = np.array([sensor.position for sensor in sensors])
        self._rotation = np.array([sensor.rotation for sensor in sensors])
        self._gravity = np.array(world.gravity)

    def measure(self, simulation: Simulation) -> Vector:
        """Return orientation, angular velocity and acceleration."""
        q, v, a = simulation.positions(), simulation.velocities(), simulation.accelerations()
        bodies = np.empty((len(self._position), 13))
        if len(self._twists):
            bodies[self._on_base] = self._of_bases(q, v, a)
        if self._bodies:
            bodies[~self._on_base] = self._of_others(simulation, q, v, a)
        attitude, spin, linear, angular = np.split(bodies, (4, 7, 10), axis=1)
        arm = turned(attitude, self._position)
        linear = linear + cross(angular, arm) + cross(spin, cross(spin, arm))
        attitude = product(attitude, self._rotation)
        return np.concatenate(
            [attitude, turned_back(attitude, spin), turned_back(attitude, linear - self._gravity)],
            axis=1,
        )

    def _of_bases(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return how floating bases move, which their twists say: shape (bases, 13).

        In each row quaternion, angular velocity, linear and angular acceleration.
        """
        attitude = q[self._attitudes]
        along, about = self._twists + np.arange(3), self._twists + np.arange(3, 6)
        spin = v[about]
        linear = a[along] + cross(spin, v[along])
        moves = [turned(attitude, each) for each in (spin, linear, a[about])]
        return np.concatenate([attitude, *moves], axis=1)

    def _of_others(self, simulation: Simulation, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return the same of other bodies, from the simulation's kinematics."""
        attitude = simulation.body_poses(self._bodies, q)[:, 3:]
        spin = simulation.body_velocities(self._bodies, q, v)[:, 3:]
        change = self._accelerations(simulation, q, v, a)
        return np.concatenate([attitude, spin, change], axis=1)

    def _accelerations(self, simulation: Simulation, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return the changes of the bodies' velocities, shape (bodies, 6).

        Velocities are linear in `v`, so their change is that of `a` in its place, plus the change
        that the motion itself makes, by a central difference along it.
        """
        bodies, layout = self._bodies, simulation.layout
        found = simulation.body_velocities(bodies, q, a)
        fastest = float(np.abs(v).max(initial=0.0))
        if fastest:
            stride = _STRIDE / max(fastest, 1.0)
            after = simulation.body_velocities(bodies, moved(layout, q, stride * v), v)
            before = simulation.body_velocities(bodies, moved(layout, q, -stride * v), v)
            found += (after - before) / (2 * stride)
        return found


def moved(layout: Layout, positions: Vector, motion: Vector) -> Vector:
    """Return positions after a small motion, shape (nv,), that is velocities times a time."""
    found = np.empty_like(positions)
    for part in layout.parts.values():
        q, v = positions[part.positions], motion[part.velocities]
        if part.floating:
            attitude = q[3:7]
            turn = product(attitude, from_rotation_vectors(v[3:6]))
            q = np.concatenate([q[:3] + turned(attitude, v[:3]), turn, q[7:] + v[6:]])
            found[part.positions] = q
        else:
            found[part.positions] = q + v
    return found


class ContactTruth:
    """Forces of contacts on bodies."""

    def __init__(self, sensors: Sequence[ContactSensor], simulation: Simulation) -> None:
        _needs("contacts", simulation, "A ContactSensor")
        names = simulation.layout.names
        self._bodies = places_of("body", [sensor.body for sensor in sensors], names)
        self._count = len(names)

    def measure(self, simulation: Simulation) -> Vector:
        """Return touching, normal force and force."""
        contacts: Any = simulation.contacts()
        whole = np.zeros((self._count, 5))
        if len(contacts):
            force = contacts["force"]
            along = np.sum(force * contacts["normal"], axis=1)
            rows = np.column_stack([np.ones(len(contacts)), along, force])
            np.add.at(whole, contacts["body_a"], rows)
            rows[:, 2:] *= -1
            np.add.at(whole, contacts["body_b"], rows)
            np.minimum(whole[:, 0], 1.0, out=whole[:, 0])
        found: Vector = whole[self._bodies]
        return found


class ForceTorqueTruth:
    """Wrenches that joints carry."""

    def __init__(self, sensors: Sequence[ForceTorqueSensor], simulation: Simulation) -> None:
        _needs("joint_wrenches", simulation, "A ForceTorqueSensor")
        joints = [sensor.joint for sensor in sensors]
        self._joints = places_of("joint", joints, simulation.layout.joints)

    def measure(self, simulation: Simulation) -> Vector:
        """Return force and torque."""
        wrenches: Vector = simulation.joint_wrenches()[self._joints]
        return wrenches


class EffortTruth:
    """Torques that drive joints."""

    def __init__(self, sensors: Sequence[EffortSensor], simulation: Simulation) -> None:
        layout = simulation.layout
        joints = [sensor.joint for sensor in sensors]
        self._joints = places_of("joint", joints, layout.joints)
        for sensor, place in zip(sensors, self._joints, strict=True):
            if layout.modes and layout.modes[place] != "force":
                raise ConfigError(
                    f'EffortSensor "{sensor.name}": the joint "{sensor.joint}" has the mode '
                    f'"{layout.modes[place]}", so its torque is not known.'
                )

    def measure(self, simulation: Simulation) -> Vector:
        """Return the torque."""
        torques: Vector = simulation.snapshot().commands[self._joints, None]
        return torques


def truth_of(
    kind: type[Sensor], sensors: Sequence[Any], simulation: Simulation, world: World
) -> Truth:
    """Return what measures sensors of one kind.

    Raises:
        ComponentNotFoundError: A joint or body is not in the simulation.
        ConfigError: The kind is unknown, or a joint's torque is not known.
        FeatureNotSupportedError: The engine lacks what the kind needs.
    """
    if kind is Imu:
        return ImuTruth(sensors, simulation, world)
    kinds: dict[type[Sensor], Any] = {
        Encoder: EncoderTruth,
        ContactSensor: ContactTruth,
        ForceTorqueSensor: ForceTorqueTruth,
        EffortSensor: EffortTruth,
    }
    if kind not in kinds:
        raise ConfigError(f"{kind.__name__} is no kind of sensor that is known.")
    found: Truth = kinds[kind](sensors, simulation)
    return found


def _needs(feature: str, simulation: Simulation, what: str) -> None:
    if feature not in simulation.features:
        raise FeatureNotSupportedError(
            simulation.engine, feature, simulation.features, f"{what} needs it."
        )
