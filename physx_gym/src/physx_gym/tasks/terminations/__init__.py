"""Conditions that end an episode."""

from __future__ import annotations

from physx_gym.tasks.terminations.presets import (
    base_height,
    collision,
    high_contact_force,
    high_power,
    lost_ground,
    roll_pitch,
    slippage,
    unsafe_joints,
)
from physx_gym.tasks.terminations.termination import Drift, OutOfBounds, Shift, Termination

__all__ = [
    "Drift",
    "OutOfBounds",
    "Shift",
    "Termination",
    "base_height",
    "collision",
    "high_contact_force",
    "high_power",
    "lost_ground",
    "roll_pitch",
    "slippage",
    "unsafe_joints",
]
