"""Motors and sensors of a simulation, driven and read by a control loop."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from physx_core.typing import Vector
from physx_sim import (
    Camera,
    Encoder,
    Imu,
    Layout,
    Motor,
    Motors,
    MotorState,
    Part,
    Sensor,
    Sensors,
    SensorState,
    Simulation,
    World,
)

_KINDS = {"ContactSensor": "Contact", "EffortSensor": "Effort", "ForceTorqueSensor": "ForceTorque"}
"""Names of kinds of sensors in measurements, where they differ from the class names."""


def default_motors(layout: Layout, part: Part) -> tuple[Motor, ...]:
    """Return an ideal motor for each joint that is driven by a limited torque."""
    modes = layout.modes or ("force",) * len(layout.joints)
    places = range(part.joints.start, part.joints.stop)
    driven = [i for i in places if modes[i] == "force" and math.isfinite(layout.max_torque[i])]
    return tuple(Motor(joint=layout.joints[i]) for i in driven)


def default_sensors(
    simulation: Simulation, part: Part, motors: Sequence[Motor]
) -> tuple[Sensor, ...]:
    """Return an encoder for each motor and, if the base floats, an inertial sensor on it."""
    found: list[Sensor] = [Encoder(name=motor.joint, joint=motor.joint) for motor in motors]
    if part.floating and "accelerations" in simulation.features:
        base = simulation.layout.bodies[part.bodies.start]
        taken = {sensor.name for sensor in found}
        found.append(Imu(name=f"{base}_imu" if base in taken else base, body=base))
    return tuple(found)


def kind_of(sensor: Sensor) -> str:
    """Return the name of a sensor's kind in measurements."""
    name = type(sensor).__name__
    return _KINDS.get(name, name)


EquipmentState = tuple[MotorState | None, SensorState | None]
"""A snapshot of motors and sensors; None: there are none."""


class Equipment:
    """Motors and sensors on a simulation.

    Motors whose torque depends only on the command, and sensors without memory, run only when the
    control loop commands and reads them; the others also run before every physics step.

    Attributes:
        motors: The motors; None: the robot has none.
        sensors: The sensors; None: there are none.
        size: Number of values that the sensors measure.
        max_commands: Maximum torques of the motors' shafts, shape (motors,), in N m or N.
        command: Sends a command, shape (motors,), to the motors.
        torques: Writes the torques on the motors' joints, shape (motors,), in N m or N.
    """

    def __init__(
        self,
        simulation: Simulation,
        world: World,
        motors: Sequence[Motor],
        sensors: Sequence[Sensor],
        random: np.random.Generator,
    ) -> None:
        self._simulation = simulation
        self.motors = Motors(simulation, world, motors) if motors else None
        self.sensors = Sensors(simulation, world, sensors, random) if sensors else None
        self.size = 0 if self.sensors is None else self.sensors.size
        self._seen = np.zeros(0) if self.sensors is None else self.sensors.view
        self.max_commands = _max_commands(simulation.layout, motors)
        self._memoryless = all(_is_memoryless(motor) for motor in motors)
        self._direct = _DirectMotors(simulation, motors)
        self._lookup = _lookup(simulation.layout, self.sensor_list)
        self.command: Callable[[Vector], None] = self._direct.command
        self.torques: Callable[[Vector], None] = self._direct.torques
        if self.motors is not None and not self._memoryless:
            self.command, self.torques = self.motors.set_commands, self._read_torques
        self._every = [
            1 if sensor.period is None else round(sensor.period / simulation.period)
            for sensor in sensors
        ]
        self._remembers = any(
            sensor.delay or sensor.jitter or any(sensor.amounts("random_walk"))
            for sensor in sensors
        )
        self._hooked = False
        if self.motors is not None and not self._memoryless:
            self.motors.attach(simulation)

    @property
    def sensor_list(self) -> tuple[Sensor, ...]:
        """The sensors in the order of their values."""
        return () if self.sensors is None else self.sensors.sensors

    def begin(self, random: np.random.Generator, reading_period: int) -> None:
        """Start from the simulation's present state.

        Args:
            random: Generator of the sensors' errors.
            reading_period: Measurements are read at multiples of this number of physics steps.
        """
        if self._memoryless:
            self._direct.begin()
        elif self.motors is not None:
            self.motors.reset(self._simulation)
        if self.sensors is not None and self._lookup is None:
            self.sensors.reset(random)
            self._hook(reading_period)

    def _hook(self, reading_period: int) -> None:
        """Have sensors measure before physics steps too, if that makes a difference."""
        sensors = self.sensors
        if sensors is None:
            return
        fits = all(
            every % reading_period == 0 or reading_period % every == 0 for every in self._every
        )
        wanted = self._remembers or not fits
        if wanted and not self._hooked:
            sensors.attach(self._simulation)
        elif self._hooked and not wanted:
            self._simulation.remove_hook(sensors)
        self._hooked = wanted

    def _read_torques(self, out: Vector) -> None:
        if self.motors is not None:
            out[:] = self.motors.torques_view

    def measure(self, state: Vector, out: Vector) -> None:
        """Write what the sensors measure.

        Args:
            state: Positions, then velocities of the world, shape (nq + nv,).
            out: Shape (size,).
        """
        if self._lookup is not None:
            state.take(self._lookup, None, out, "clip")
        elif self.sensors is not None:
            self.sensors.update(self._simulation)
            out[:] = self._seen

    def by_kind(self, values: Vector) -> dict[str, Vector]:
        """Return views of an array of sensor values: for each kind, shape (values, sensors).

        Sensors of a kind that differ in size are apart, by their names; so is each image of a
        camera, named after the camera and the image, in its shape.
        """
        found: dict[str, Vector] = {}
        rest = values
        for kind, group in itertools.groupby(self.sensor_list, type):
            members = list(group)
            widths = [sum(sensor.quantities.values()) for sensor in members]
            own, rest = np.split(rest, [sum(widths)])
            if len(set(widths)) == 1 and kind is not Camera:
                found[kind_of(members[0])] = own.reshape(len(members), -1).T
                continue
            for sensor, part in zip(members, np.split(own, np.cumsum(widths)[:-1]), strict=True):
                found |= (
                    _images(sensor, part)
                    if isinstance(sensor, Camera)
                    else {sensor.name: part[:, None]}
                )
        return found

    def snapshot(self) -> EquipmentState:
        """Return everything that `restore` needs to continue exactly from here."""
        motors = None if self.motors is None else self.motors.snapshot()
        return motors, None if self.sensors is None else self.sensors.snapshot()

    def restore(
        self, state: EquipmentState, random: np.random.Generator, reading_period: int
    ) -> None:
        """Restore a snapshot, with a generator already in its state of that time; see `begin`."""
        motors, sensors = state
        if self.motors is not None and motors is not None:
            self.motors.restore(motors)
        if self.sensors is not None and sensors is not None and self._lookup is None:
            self.sensors.reset(random)
            self.sensors.restore(sensors)
            self._hook(reading_period)


def _images(camera: Camera, values: Vector) -> dict[str, Vector]:
    ends = np.cumsum(list(camera.quantities.values()))[:-1]
    return {
        f"{camera.name}.{image}": pixels.reshape(camera.shape_of(image))
        for image, pixels in zip(camera.images, np.split(values, ends), strict=True)
    }


class _DirectMotors:
    """Motors whose torque depends only on the command."""

    def __init__(self, simulation: Simulation, motors: Sequence[Motor]) -> None:
        self._simulation, layout = simulation, simulation.layout
        places = [layout.joints.index(each.joint) for each in motors if each.joint in layout.joints]
        self._places = np.array(places, np.intp)
        self._most = np.array([motor.max_torque for motor in motors])
        weakest = float(self._most.min(initial=np.inf))
        self._never_cut = weakest * weakest  # commands of a smaller squared norm are not clipped
        self._reduction = np.array([motor.reduction for motor in motors])
        self._geared = bool((self._reduction != 1.0).any())
        self._commands = simulation.commands()
        self._own: Vector | None = None  # view of the motors' commands, if they are adjacent
        first = places[0] if places else 0
        if places == list(range(first, first + len(places))):
            whole = len(places) == len(self._commands)
            self._own = self._commands if whole else self._commands[first : first + len(places)]

    def begin(self) -> None:
        """Start with commands of 0."""
        self._commands[:] = self._simulation.commands()
        self._commands[self._places] = 0.0
        self._simulation.set_commands(self._commands)

    def command(self, command: Vector) -> None:
        """Apply torques, shape (motors,), from now on."""
        if command.dot(command) > self._never_cut:
            command = np.minimum(np.maximum(command, -self._most), self._most)
        if self._geared:
            command = command * self._reduction
        if self._own is self._commands:
            self._simulation.set_commands(command)
            return
        if self._own is not None:
            self._own[:] = command
        else:
            self._commands[self._places] = command
        self._simulation.set_commands(self._commands)

    def torques(self, out: Vector) -> None:
        """Write the torques on the joints, shape (motors,), after clipping at the joint limits."""
        self._simulation.commands().take(self._places, None, out, "clip")


def _lookup(layout: Layout, sensors: Sequence[Sensor]) -> Any:
    """Return the indices of the measured values in positions and velocities.

    None if sensors measure anything else, or with errors.
    """
    found = []
    for sensor in sensors:
        exact = isinstance(sensor, Encoder) and sensor.reduction == 1.0 and sensor.period is None
        errors = ("noise", "bias", "bias_deviation", "random_walk")
        wrong = any(any(sensor.amounts(option)) for option in errors)
        if not exact or wrong or sensor.delay or sensor.jitter:
            return None
        joint = sensor.joint  # type: ignore[attr-defined]
        found += [layout.position_index[joint], layout.nq + layout.velocity_index[joint]]
    return np.array(found, np.intp) if found else None


def _is_memoryless(motor: Motor) -> bool:
    """Return whether a motor's torque depends only on the command."""
    frictions: Any = (motor.viscous, motor.dry)
    has_friction = any(any(each) for each in frictions)
    is_limited = math.isfinite(motor.max_velocity)
    return not has_friction and not is_limited and motor.stiffness is None and motor.period is None


def _max_commands(layout: Layout, motors: Sequence[Motor]) -> Vector:
    limits = dict(zip(layout.joints, layout.max_torque.tolist(), strict=True))
    found = [min(each.max_torque, limits[each.joint] / abs(each.reduction)) for each in motors]
    return np.array(found, np.float64)
