"""Sensors of a robot, with their imperfections, the same on every engine."""

from __future__ import annotations

from physx_core.simulation.sensors.sensor import (
    ContactSensor,
    EffortSensor,
    Encoder,
    ForceTorqueSensor,
    Imu,
    Sensor,
)
from physx_core.simulation.sensors.sensors import Sensors, SensorState

__all__ = [
    "ContactSensor",
    "EffortSensor",
    "Encoder",
    "ForceTorqueSensor",
    "Imu",
    "Sensor",
    "SensorState",
    "Sensors",
]
