"""Motors, which turn commands into joint torques, the same on every engine."""

from __future__ import annotations

from physx_core.simulation.motors.motor import Motor, with_rotors
from physx_core.simulation.motors.motors import Motors, MotorState

__all__ = ["Motor", "MotorState", "Motors", "with_rotors"]
