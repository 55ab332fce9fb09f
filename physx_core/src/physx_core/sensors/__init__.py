"""Sensors: what a robot measures of itself, with a sensor's imperfections, on every engine."""

from __future__ import annotations

from physx_core.sensors.description import (
    ContactSensor,
    EffortSensor,
    Encoder,
    ForceTorqueSensor,
    Imu,
    Sensor,
)
from physx_core.sensors.sensors import Sensors, SensorState

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
