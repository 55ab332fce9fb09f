"""The columns and the description of the simulator that every log has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from physx_core import __version__
from physx_core.config import reference_of
from physx_gym.simulator.equipment import kind_of
from physx_gym.simulator.simulator import Simulator
from physx_gym.telemetry.episode_log import POSITIONS, VELOCITIES
from physx_gym.telemetry.telemetry import Telemetry
from physx_sim import Layout, Part, Sensor

BASE_POSITION = {"x": "m", "y": "m", "z": "m", "qx": "", "qy": "", "qz": "", "qw": ""}
"""Coordinates of the position of a floating base or an object, and their units."""
BASE_VELOCITY = {"vx": "m/s", "vy": "m/s", "vz": "m/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
"""Components of its velocity, and their units."""
_SENSED = {
    "orientation": "",
    "angular_velocity": "rad/s",
    "acceleration": "m/s²",
    "normal_force": "N",
    "force": "N",
}
"""Units of measured quantities that do not depend on the type of a joint."""
_EFFORTS = {"rad": "N m", "m": "N"}
"""Unit of a joint's torque or force, by the unit of its position."""


def register_simulator(telemetry: Telemetry, simulator: Simulator) -> None:
    """Register the state of the world, the sensors, and the commands and torques of the motors.

    Measurements are recorded in training too. Call this whenever the simulator has been built, as
    it then has new arrays.
    """
    layout, state = simulator.layout, simulator.robot_state
    positions, velocities = state_names(layout)
    units = state_units(layout)
    always: dict[str, Any] = {"is_eval_only": False}
    telemetry.register(POSITIONS, simulator.positions, positions, unit=units[0], **always)
    telemetry.register(VELOCITIES, simulator.velocities, velocities, unit=units[1], **always)
    joints = dict(zip(layout.joints, layout.units, strict=False))
    for kind, values in simulator.measurements.get("measurements", {}).items():
        sensors = [each for each in simulator.sensors if kind in (kind_of(each), each.name)]
        if not sensors:  # an image, too large for columns
            continue
        sensed = [
            _unit_of(quantity, kind, joints.get(getattr(sensor, "joint", ""), ""))
            for sensor in sensors
            for quantity, size in sensor.quantities.items()
            for _ in range(size)
        ]
        names = sensor_names(sensors)
        telemetry.register(f"sensor.{kind}", values.T, names, unit=sensed, **always)
    motors = [motor.joint for motor in simulator.motors]
    if "accelerations" in simulator.simulation.features:
        own = simulator.robot.velocities
        accelerations = [f"{unit}²" if unit else "" for unit in units[1][own]]
        telemetry.register("state.a", state.a, velocities[own], unit=accelerations)
    efforts = [_EFFORTS.get(joints.get(joint, ""), "") for joint in motors]
    telemetry.register("motor.command", state.command, motors, unit=efforts)
    telemetry.register("motor.torque", state.torques, motors, unit=efforts)


def _unit_of(quantity: str, kind: str, joint: str) -> str:
    """Return the unit of what a kind of sensor measures, given the unit of its joint, if any."""
    if quantity == "torque":
        return "N m" if kind == "ForceTorque" else _EFFORTS.get(joint, "")
    known = {"position": joint, "velocity": f"{joint}/s" if joint else ""}
    return _SENSED.get(quantity, known.get(quantity, ""))


def state_names(layout: Layout) -> tuple[list[str], list[str]]:
    """Return the names of the positions and velocities of a world: part, then coordinate."""
    positions, velocities = [""] * layout.nq, [""] * layout.nv
    for part in layout.parts.values():
        joints = _joints(layout, part)
        base = (BASE_POSITION, BASE_VELOCITY) if part.floating else ({}, {})
        positions[part.positions] = [f"{part.name}.{each}" for each in (*base[0], *joints)]
        velocities[part.velocities] = [f"{part.name}.{each}" for each in (*base[1], *joints)]
    return positions, velocities


def state_units(layout: Layout) -> tuple[list[str], list[str]]:
    """Return the units of the positions and velocities of a world."""
    positions, velocities = [""] * layout.nq, [""] * layout.nv
    for part in layout.parts.values():
        base = (BASE_POSITION, BASE_VELOCITY) if part.floating else ({}, {})
        units = (layout.units or ("",) * len(layout.joints))[part.joints]
        positions[part.positions] = [*base[0].values(), *units]
        velocities[part.velocities] = [*base[1].values(), *(unit and f"{unit}/s" for unit in units)]
    return positions, velocities


def _joints(layout: Layout, part: Part) -> list[str]:
    return [joint.removeprefix(f"{part.name}/") for joint in layout.joints[part.joints]]


def sensor_names(sensors: Sequence[Sensor]) -> list[list[str]]:
    """Return the names of the values of each sensor of a kind: sensor, quantity, index."""
    return [
        [
            f"{sensor.name}.{quantity}" + (f".{number}" if size > 1 else "")
            for quantity, size in sensor.quantities.items()
            for number in range(size)
        ]
        for sensor in sensors
    ]


def describe_simulator(simulator: Simulator) -> dict[str, Any]:
    """Return the description of a simulator in a log."""
    return {
        "physx": __version__,
        "world": simulator.world,
        "backend": reference_of(simulator.backend),
        "robot": simulator.robot.name,
        "urdf": {robot.name: str(robot.urdf) for robot in simulator.world.robots},
        "parts": {
            part.name: {
                "positions": [part.positions.start, part.positions.stop],
                "velocities": [part.velocities.start, part.velocities.stop],
            }
            for part in simulator.layout.parts.values()
        },
        "options": simulator.get_options(),
    }
