"""What every environment records, and what its logs say beside the columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from physx_core import __version__
from physx_core.config import reference_of
from physx_core.simulation import Layout, Part, Sensor
from physx_gym.simulator.equipment import kind_of
from physx_gym.telemetry.log import POSITIONS, VELOCITIES
from physx_gym.telemetry.telemetry import Telemetry

if TYPE_CHECKING:
    from physx_gym.env.pipeline_env import PipelineEnv
    from physx_gym.simulator.simulator import Simulator

BASE_POSITION = {"x": "m", "y": "m", "z": "m", "qx": "", "qy": "", "qz": "", "qw": ""}
"""Numbers of a floating base's or an object's position, and their units."""
BASE_VELOCITY = {"vx": "m/s", "vy": "m/s", "vz": "m/s", "wx": "rad/s", "wy": "rad/s", "wz": "rad/s"}
"""Likewise of its velocity."""
_SENSED = {
    "orientation": "",
    "angular_velocity": "rad/s",
    "acceleration": "m/s²",
    "normal_force": "N",
    "force": "N",
}
"""Units of what sensors measure, where they do not depend on the kind of a joint."""


def register_simulator(telemetry: Telemetry, simulator: Simulator) -> None:
    """Register the world's state, the sensors, and what the motors do.

    To be called before each episode: a simulator whose options changed has other arrays.
    """
    layout, state = simulator.layout, simulator.robot_state
    positions, velocities = state_names(layout)
    units = [BASE_POSITION.get(name.rpartition(".")[2], "") for name in positions]
    telemetry.register(POSITIONS, simulator.positions, positions, unit=units)
    units = [BASE_VELOCITY.get(name.rpartition(".")[2], "") for name in velocities]
    telemetry.register(VELOCITIES, simulator.velocities, velocities, unit=units)
    for kind, values in simulator.measurements.get("measurements", {}).items():
        sensors = [sensor for sensor in simulator.sensors if kind_of(sensor) == kind]
        units = [
            _SENSED.get(quantity, "N m" if kind == "ForceTorque" else "")
            for sensor in sensors
            for quantity, size in sensor.quantities.items()
            for _ in range(size)
        ]
        telemetry.register(f"sensor.{kind}", values.T, sensor_names(sensors), unit=units)
    motors = [motor.joint for motor in simulator.motors]
    if "accelerations" in simulator.simulation.features:
        telemetry.register("state.a", state.a, velocities[simulator.robot.velocities])
    telemetry.register("motor.command", state.command, motors)
    telemetry.register("motor.torque", state.torques, motors)


def state_names(layout: Layout) -> tuple[list[str], list[str]]:
    """Return names of the positions and of the velocities of a world: part, then place in it."""
    positions, velocities = [""] * layout.nq, [""] * layout.nv
    for part in layout.parts.values():
        joints = _joints(layout, part)
        base = (BASE_POSITION, BASE_VELOCITY) if part.floating else ({}, {})
        positions[part.positions] = [f"{part.name}.{each}" for each in (*base[0], *joints)]
        velocities[part.velocities] = [f"{part.name}.{each}" for each in (*base[1], *joints)]
    return positions, velocities


def _joints(layout: Layout, part: Part) -> list[str]:
    return [joint.removeprefix(f"{part.name}/") for joint in layout.joints[part.joints]]


def sensor_names(sensors: Sequence[Sensor]) -> list[list[str]]:
    """Return names of the values of each sensor of a kind: sensor, quantity, number in it."""
    return [
        [
            f"{sensor.name}.{quantity}" + (f".{number}" if size > 1 else "")
            for quantity, size in sensor.quantities.items()
            for number in range(size)
        ]
        for sensor in sensors
    ]


def constants_of(env: PipelineEnv) -> dict[str, Any]:
    """Return what a log says of an environment beside its columns."""
    simulator, layout = env.simulator, env.simulator.layout
    return {
        "environment": type(env).__name__,
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
            for part in layout.parts.values()
        },
        "options": simulator.get_options(),
        "seed": env.np_random_seed,
        "step_dt": env.step_dt,
        "control_dt": env.control_dt,
        "observe_dt": env.observe_dt,
    }
