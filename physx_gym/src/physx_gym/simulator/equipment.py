"""The motors and sensors of a simulation, read and driven at the moments of a control loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from physx_core.simulation import (
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
from physx_core.typing import Vector

_KINDS = {"ContactSensor": "Contact", "EffortSensor": "Effort", "ForceTorqueSensor": "ForceTorque"}
"""Names of sensors' kinds in measurements, where they are not those of their classes."""


def default_motors(layout: Layout, part: Part) -> tuple[Motor, ...]:
    """Return a motor without imperfections for each joint that is driven by a limited torque."""
    modes = layout.modes or ("force",) * len(layout.joints)
    places = range(part.joints.start, part.joints.stop)
    driven = [i for i in places if modes[i] == "force" and math.isfinite(layout.max_torque[i])]
    return tuple(Motor(joint=layout.joints[i]) for i in driven)


def default_sensors(
    simulation: Simulation, part: Part, motors: Sequence[Motor]
) -> tuple[Sensor, ...]:
    """Return an encoder for each motor, and an inertial sensor on a base that floats."""
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


@dataclass(frozen=True)
class EquipmentState:
    """A snapshot of motors and sensors; plain and picklable.

    Attributes:
        motors: Of the motors; None: there are none.
        sensors: Of the sensors, likewise.
    """

    motors: MotorState | None
    sensors: SensorState | None


class Equipment:
    """Motors and sensors on a simulation.

    They run once at each moment of the control loop where that is the same as before every physics
    step: motors whose torque depends on the command alone, sensors without a past.

    Attributes:
        motors: None: the robot has no motors.
        sensors: None: there are no sensors.
        size: Number of values that the sensors measure.
        most: Highest torques of the motors' shafts, shape (motors,), in N m or N.
        command: Lets the motors take over their command, shape (motors,).
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
        self.most = _highest(simulation.layout, motors)
        self._steady = all(_steady(motor) for motor in motors)
        self._drive = _Drive(simulation, motors)
        self._lookup = _lookup(simulation.layout, self.sensor_list)
        self.command: Callable[[Vector], None] = self._drive
        self.torques: Callable[[Vector], None] = self._drive.torques
        if self.motors is not None and not self._steady:
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
        if self.motors is not None and not self._steady:
            self.motors.attach(simulation)

    @property
    def sensor_list(self) -> tuple[Sensor, ...]:
        """The sensors in the order of their values."""
        return () if self.sensors is None else self.sensors.sensors

    def begin(self, random: np.random.Generator, moment: int) -> None:
        """Begin anew from the simulation's present state.

        Args:
            random: What errors of sensors are drawn from.
            moment: Measurements are read at multiples of so many physics steps.
        """
        if self._steady:
            self._drive.begin()
        elif self.motors is not None:
            self.motors.reset(self._simulation)
        if self.sensors is not None and self._lookup is None:
            self.sensors.reset(random)
            self._hook(moment)

    def _hook(self, moment: int) -> None:
        """Let sensors measure before physics steps too, where that makes a difference."""
        sensors = self.sensors
        if sensors is None:
            return
        fits = all(every % moment == 0 or moment % every == 0 for every in self._every)
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
            state: Positions and velocities of the world, one after the other.
            out: Shape (size,).
        """
        if self._lookup is not None:
            state.take(self._lookup, None, out, "clip")
        elif self.sensors is not None:
            self.sensors.update(self._simulation)
            out[:] = self._seen

    def by_kind(self, values: Vector) -> dict[str, Vector]:
        """Return parts of an array of the sensors' values: for each kind (values, sensors)."""
        found, begin = {}, 0
        sensors = self.sensor_list
        for kind in dict.fromkeys(type(sensor) for sensor in sensors):
            members = [sensor for sensor in sensors if type(sensor) is kind]
            width = sum(kind.quantities.values())
            end = begin + width * len(members)
            found[kind_of(members[0])] = values[begin:end].reshape(len(members), width).T
            begin = end
        return found

    def snapshot(self) -> EquipmentState:
        """Return everything that `restore` needs to go on exactly from here."""
        return EquipmentState(
            None if self.motors is None else self.motors.snapshot(),
            None if self.sensors is None else self.sensors.snapshot(),
        )

    def restore(self, state: EquipmentState, random: np.random.Generator, moment: int) -> None:
        """Go back to a snapshot; see `begin` for the generator, which the snapshot winds back."""
        if self.motors is not None and state.motors is not None:
            self.motors.restore(state.motors)
        if self.sensors is not None and state.sensors is not None and self._lookup is None:
            self.sensors.reset(random)
            self.sensors.restore(state.sensors)
            self._hook(moment)


class _Drive:
    """Motors whose torque depends on nothing but the command."""

    def __init__(self, simulation: Simulation, motors: Sequence[Motor]) -> None:
        self._simulation, layout = simulation, simulation.layout
        places = [layout.joints.index(each.joint) for each in motors if each.joint in layout.joints]
        self._places = np.array(places, np.intp)
        self._most = np.array([motor.max_torque for motor in motors])
        tame = float(self._most.min(initial=np.inf))
        self._tame = tame * tame  # square of a length up to which no command needs to be cut
        self._reduction = np.array([motor.reduction for motor in motors])
        self._geared = bool((self._reduction != 1.0).any())
        self._commands = simulation.commands()
        self._own: Vector | None = None  # those of the motors, where they stand side by side
        first = places[0] if places else 0
        if places == list(range(first, first + len(places))):
            whole = len(places) == len(self._commands)
            self._own = self._commands if whole else self._commands[first : first + len(places)]

    def begin(self) -> None:
        """Begin with commands of 0."""
        self._commands[:] = self._simulation.commands()
        self._commands[self._places] = 0.0
        self._simulation.set_commands(self._commands)

    def __call__(self, command: Vector) -> None:
        """Let torques act from now on."""
        if command.dot(command) > self._tame:
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
        """Write the torques on the joints, shape (motors,), as the joints' limits cut them."""
        self._simulation.commands().take(self._places, None, out, "clip")


def _lookup(layout: Layout, sensors: Sequence[Sensor]) -> Any:
    """Return places of what sensors measure in positions and velocities; None: it is not there."""
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


def _steady(motor: Motor) -> bool:
    """Return whether a motor's torque depends on nothing but the command."""
    rubs: Any = (motor.viscous, motor.dry)
    friction = any(any(each) for each in rubs)
    limited = math.isfinite(motor.max_velocity)
    return not friction and not limited and motor.stiffness is None and motor.period is None


def _highest(layout: Layout, motors: Sequence[Motor]) -> Vector:
    limits = dict(zip(layout.joints, layout.max_torque.tolist(), strict=True))
    found = [min(each.max_torque, limits[each.joint] / abs(each.reduction)) for each in motors]
    return np.array(found, np.float64)
