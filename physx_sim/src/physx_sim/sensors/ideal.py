"""Ideal sensors: noise-free measurements, one class for all sensors of a kind.

They only use the interface of `Simulation`, so they are independent of the engine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from physx_core.errors import ConfigError
from physx_core.rotations import IDENTITY, cross, multiply, rotate, rotate_back, to_matrix
from physx_core.typing import Vector
from physx_sim.backend import Simulation
from physx_sim.description.world import World
from physx_sim.devices import as_slice, places_of
from physx_sim.errors import FeatureNotSupportedError
from physx_sim.sensors.sensor import (
    Camera,
    ContactSensor,
    EffortSensor,
    Encoder,
    ForceTorqueSensor,
    HeightScan,
    Imu,
    Lidar,
    Sensor,
)


class IdealSensors(Protocol):
    """Noise-free measurements of all sensors of one kind."""

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write the components of all sensors to `out`, shape (sensors, width)."""


class IdealEncoders:
    """Positions and velocities of joints."""

    def __init__(self, sensors: Sequence[Encoder], simulation: Simulation) -> None:
        joints = [sensor.joint for sensor in sensors]
        self._q = as_slice(places_of("joint", joints, simulation.layout.position_index))
        self._v = as_slice(places_of("joint", joints, simulation.layout.velocity_index))
        reduction = np.array([sensor.reduction for sensor in sensors])[:, None]
        self._reduction = None if (reduction == 1).all() else reduction

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write position and velocity."""
        out[:, 0] = simulation.positions()[self._q]
        out[:, 1] = simulation.velocities()[self._v]
        if self._reduction is not None:
            out *= self._reduction


class IdealImus:
    """Orientations, angular velocities, and accelerations of points on bodies."""

    def __init__(self, sensors: Sequence[Imu], simulation: Simulation, world: World) -> None:
        _require("accelerations", simulation, "An Imu")
        self._bodies = [sensor.body for sensor in sensors]
        places_of("body", self._bodies, simulation.layout.names)
        self._arms = [_none_if(sensor.position, (0.0, 0.0, 0.0)) for sensor in sensors]
        self._rotations = [_none_if(sensor.rotation, IDENTITY) for sensor in sensors]
        self._gravity: Sequence[float] = world.gravity
        self._changes = "gravity" in simulation.features
        layout = simulation.layout
        floating = [part for part in layout.parts.values() if part.floating]
        bases = {layout.bodies[part.bodies.start]: part for part in floating}
        self._bases = [bases[body] for body in self._bodies if body in bases]

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write orientation, angular velocity, and acceleration."""
        if self._changes:
            self._gravity = simulation.gravity.tolist()
        if len(self._bases) == len(out):
            self._measure_bases(simulation, out)
            return
        motions = simulation.body_motions(self._bodies).tolist()
        for row, motion in enumerate(motions):
            out[row] = self._components_of(motion, self._arms[row], self._rotations[row])

    def _measure_bases(self, simulation: Simulation, out: Vector) -> None:
        """Measure sensors that are all on floating bases, whose motion is part of the state."""
        state = simulation.positions(), simulation.velocities(), simulation.accelerations()
        for row, base in enumerate(self._bases):
            first = base.velocities.start
            x, y, z, w = state[0][base.positions][3:7].tolist()
            attitude: Sequence[float] = (x, y, z, w) if w >= 0 else (-x, -y, -z, -w)
            g, h, o, p, q, r = state[1][first : first + 6].tolist()
            a, b, c, d, e, f = state[2][first : first + 6].tolist()
            # The velocity is in a rotating frame.
            i, j, k = rotate_back(attitude, *self._gravity)
            s, t, u = cross(p, q, r, g, h, o)
            a, b, c = a + s - i, b + t - j, c + u - k
            arm, rotation = self._arms[row], self._rotations[row]
            if arm is not None:
                i, j, k = cross(d, e, f, *arm)
                s, t, u = cross(p, q, r, *cross(p, q, r, *arm))
                a, b, c = a + i + s, b + j + t, c + k + u
            if rotation is not None:
                attitude = multiply(attitude, rotation)
                p, q, r = rotate_back(rotation, p, q, r)
                a, b, c = rotate_back(rotation, a, b, c)
            out[row] = (*attitude, p, q, r, a, b, c)

    def _components_of(
        self, motion: list[float], arm: Sequence[float] | None, rotation: Sequence[float] | None
    ) -> tuple[float, ...]:
        """Return the components of one sensor from a row of `Simulation.body_motions`."""
        attitude: Sequence[float] = motion[3:7]
        p, q, r, x, y, z, a, b, c = motion[10:]
        if arm is not None:
            i, j, k = rotate(attitude, *arm)
            s, t, u = cross(p, q, r, i, j, k)
            s, t, u = cross(p, q, r, s, t, u)
            i, j, k = cross(a, b, c, i, j, k)
            x, y, z = x + i + s, y + j + t, z + k + u
        if rotation is not None:
            attitude = multiply(attitude, rotation)
        i, j, k = self._gravity
        return (
            *attitude,
            *rotate_back(attitude, p, q, r),
            *rotate_back(attitude, x - i, y - j, z - k),
        )


class IdealContactSensors:
    """Contact forces on bodies."""

    def __init__(self, sensors: Sequence[ContactSensor], simulation: Simulation) -> None:
        _require("contacts", simulation, "A ContactSensor")
        bodies = [sensor.body for sensor in sensors]
        self._rows: dict[int, list[int]] = {}
        for row, place in enumerate(places_of("body", bodies, simulation.layout.names).tolist()):
            self._rows.setdefault(place, []).append(row)

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write touching, normal force, and force."""
        sums = [[0.0] * 5 for _ in out]
        for first, second, _, (x, y, z), (a, b, c), *_ in simulation.contacts().tolist():
            for place, sign in ((first, 1.0), (second, -1.0)):
                for row in self._rows.get(place, ()):
                    mine = sums[row]
                    mine[0] = 1.0
                    mine[1] += x * a + y * b + z * c
                    mine[2] += sign * x
                    mine[3] += sign * y
                    mine[4] += sign * z
        out[:] = sums


class IdealForceTorqueSensors:
    """Wrenches transmitted by joints."""

    def __init__(self, sensors: Sequence[ForceTorqueSensor], simulation: Simulation) -> None:
        _require("joint_wrenches", simulation, "A ForceTorqueSensor")
        joints = [sensor.joint for sensor in sensors if sensor.joint]
        self._joints = places_of("joint", joints, simulation.layout.joints)
        self._jointed = [row for row, sensor in enumerate(sensors) if sensor.joint]
        self._links = [sensor.link for sensor in sensors if sensor.link]
        places_of("body", self._links, simulation.layout.bodies)
        self._linked = [row for row, sensor in enumerate(sensors) if sensor.link]

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write force and torque."""
        if self._jointed:
            out[self._jointed] = simulation.joint_wrenches()[self._joints]
        if self._linked:
            out[self._linked] = simulation.link_wrenches(self._links)


class IdealLidars:
    """Distances along rays from points on bodies."""

    def __init__(self, sensors: Sequence[Lidar], simulation: Simulation) -> None:
        _require("raycast", simulation, "A Lidar")
        self._sensors = sensors
        self._bodies = [sensor.body for sensor in sensors]
        for sensor in sensors:
            places_of("body", [sensor.body, *sensor.ignored], simulation.layout.names)
        self._ways = [
            sensor.reach * np.array(sensor.directions) @ to_matrix(sensor.rotation).T
            for sensor in sensors
        ]

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write the distances."""
        poses = simulation.body_poses(self._bodies)
        for row, sensor, ways, pose in zip(out, self._sensors, self._ways, poses, strict=True):
            turn = to_matrix(pose[3:])
            begin = pose[:3] + turn @ sensor.position
            begins, ends = np.broadcast_to(begin, ways.shape), begin + ways @ turn.T
            hits = simulation.raycast(begins, ends, (sensor.body, *sensor.ignored))
            row[:] = np.where(hits["hit"], hits["fraction"], 1.0) * sensor.reach


class IdealHeightScans:
    """Heights below points around bodies."""

    def __init__(self, sensors: Sequence[HeightScan], simulation: Simulation) -> None:
        _require("raycast", simulation, "A HeightScan")
        self._sensors = sensors
        self._bodies = [sensor.body for sensor in sensors]
        for sensor in sensors:
            places_of("body", [sensor.body, *sensor.ignored], simulation.layout.names)
        self._points = [np.array(sensor.points) for sensor in sensors]

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write the heights."""
        poses = simulation.body_poses(self._bodies)
        for row, sensor, points, pose in zip(out, self._sensors, self._points, poses, strict=True):
            x, y, _ = rotate(pose[3:].tolist(), 1.0, 0.0, 0.0)
            length = math.hypot(x, y)
            cos, sin = (x / length, y / length) if length > 0 else (1.0, 0.0)
            begins = np.empty((len(points), 3))
            begins[:, :2] = pose[:2] + points @ np.array([[cos, sin], [-sin, cos]])
            begins[:, 2] = pose[2] + sensor.reach
            ends = begins - (0.0, 0.0, 2 * sensor.reach)
            hits = simulation.raycast(begins, ends, (sensor.body, *sensor.ignored))
            row[:] = (1 - 2 * np.where(hits["hit"], hits["fraction"], 1.0)) * sensor.reach


class IdealCameras:
    """Images of cameras."""

    def __init__(self, sensors: Sequence[Camera], simulation: Simulation) -> None:
        _require("cameras", simulation, "A Camera")
        self._sensors = sensors
        for sensor in sensors:
            seen = [sensor.body] if sensor.body else []
            places_of("body", [*seen, *sensor.ignored], simulation.layout.names)

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write the images."""
        for row, sensor in zip(out, self._sensors, strict=True):
            images = simulation.take_images(sensor)
            row[:] = np.concatenate([images[image].ravel() for image in sensor.images])


class IdealEffortSensors:
    """Torques that drive joints."""

    def __init__(self, sensors: Sequence[EffortSensor], simulation: Simulation) -> None:
        layout = simulation.layout
        joints = [sensor.joint for sensor in sensors]
        places = places_of("joint", joints, layout.joints)
        for sensor, place in zip(sensors, places, strict=True):
            if layout.modes and layout.modes[place] != "force":
                raise ConfigError(
                    f'EffortSensor "{sensor.name}": the joint "{sensor.joint}" has the mode '
                    f'"{layout.modes[place]}", so its torque is unknown.'
                )
        self._joints = as_slice(places)

    def measure(self, simulation: Simulation, out: Vector) -> None:
        """Write the torque."""
        out[:, 0] = simulation.commands()[self._joints]


def ideal_sensors(
    kind: type[Sensor], sensors: Sequence[Any], simulation: Simulation, world: World
) -> IdealSensors:
    """Return the ideal sensors of one kind."""
    if kind is Imu:
        return IdealImus(sensors, simulation, world)
    kinds: dict[type[Sensor], Any] = {
        Encoder: IdealEncoders,
        ContactSensor: IdealContactSensors,
        ForceTorqueSensor: IdealForceTorqueSensors,
        EffortSensor: IdealEffortSensors,
        Lidar: IdealLidars,
        HeightScan: IdealHeightScans,
        Camera: IdealCameras,
    }
    if kind not in kinds:
        raise ConfigError(f"{kind.__name__} is not a known kind of sensor.")
    found: IdealSensors = kinds[kind](sensors, simulation)
    return found


@dataclass(frozen=True, eq=False)
class SensorGroup:
    """All sensors of one kind and width, and where their components are stored.

    Attributes:
        kind: Their class.
        ideal: Their noise-free measurements.
        components: Their slice of the values.
        shape: Shape of their block: sensors, components of each.
        every: Frames between two measurements of each, shape (sensors,).
        shared_every: The value of `every` shared by all of them; None if it differs.
    """

    kind: type[Sensor]
    ideal: IdealSensors
    components: slice
    shape: tuple[int, int]
    every: NDArray[np.int64]
    shared_every: int | None

    def block(self, values: Vector) -> Vector:
        """Return their part of all values as a view."""
        return values[self.components].reshape(self.shape)

    def measure(self, simulation: Simulation, out: Vector, frame: int, first: bool) -> bool:
        """Measure with the sensors that are due; return whether any was.

        Args:
            simulation: The simulation that they measure.
            out: Their block of the ideal values; rows of sensors that are not due stay unchanged.
            frame: The current frame.
            first: Whether all are due regardless of the frame.
        """
        if first or (self.shared_every is not None and frame % self.shared_every == 0):
            self.ideal.measure(simulation, out)
            return True
        if self.shared_every is not None:
            return False
        due = frame % self.every == 0
        if not due.any():
            return False
        measured = np.empty(self.shape)
        self.ideal.measure(simulation, measured)
        out[due] = measured[due]
        return True


def groups_of(
    sensors: Sequence[Sensor], every: Sequence[int], simulation: Simulation, world: World
) -> list[SensorGroup]:
    """Return the groups of sensors; those of one kind and width must be adjacent.

    Args:
        sensors: The sensors.
        every: Frames between two measurements of each.
        simulation: The simulation that they measure.
        world: The world that the simulation was built from.
    """
    found, begin = [], 0
    kinds = [(type(sensor), sum(sensor.quantities.values())) for sensor in sensors]
    for kind, width in dict.fromkeys(kinds):
        places = [place for place, each in enumerate(kinds) if each == (kind, width)]
        steps = [every[place] for place in places]
        shape = len(places), width
        end = begin + shape[0] * shape[1]
        found.append(
            SensorGroup(
                kind,
                ideal_sensors(kind, [sensors[place] for place in places], simulation, world),
                slice(begin, end),
                shape,
                np.array(steps),
                steps[0] if len(set(steps)) == 1 else None,
            )
        )
        begin = end
    return found


def _require(feature: str, simulation: Simulation, what: str) -> None:
    if feature not in simulation.features:
        raise FeatureNotSupportedError(
            simulation.engine, feature, simulation.features, f"{what} needs it."
        )


def _none_if(values: Sequence[float], nothing: Sequence[float]) -> tuple[float, ...] | None:
    """Return values as floats; None if they equal `nothing`."""
    found = tuple(float(value) for value in values)
    return None if found == tuple(nothing) else found
