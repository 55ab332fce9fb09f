"""Bounds of observations that hold for whatever the simulation does."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from physx_core.typing import Vector
from physx_gym.simulator.simulator import Simulator

_MARGIN = 1.1
"""How far beyond its limits a joint may be seen, as a factor."""
_HASTE = 3.0
"""The same for velocities: a limit that is met in a hurry is exceeded for some steps."""
FASTEST = 100.0
"""Bound of velocities without a limit of their own, in m/s or rad/s."""


def box(*bounds: ArrayLike) -> spaces.Box:
    """Return the space of observations whose parts are within plus and minus some bounds."""
    most = np.concatenate([np.asarray(bound, np.float64).ravel() for bound in bounds])
    return spaces.Box(-most, most, dtype=np.float64)


def joint_positions(simulator: Simulator) -> Vector:
    """Return bounds of the joints' positions: the larger of their limits, and a margin."""
    layout, joints = simulator.layout, simulator.robot.joints
    farthest = np.maximum(np.abs(layout.lower[joints]), np.abs(layout.upper[joints]))
    return np.where(np.isfinite(farthest), farthest * _MARGIN + 0.1, 1e6)


def joint_velocities(simulator: Simulator) -> Vector:
    """Return bounds of the joints' velocities: their limits, and a margin."""
    fastest = simulator.layout.max_velocity[simulator.robot.joints]
    return np.where(np.isfinite(fastest), fastest * _HASTE, FASTEST)
