"""Bounds of observations that hold in any simulation."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike

from physx_core.typing import Vector
from physx_gym.simulator.simulator import Simulator

_MARGIN = 1.1
"""Factor by which positions may exceed a joint's limits."""
_OVERSHOOT = 3.0
"""The same for velocities, which may briefly overshoot a joint's limit."""
FASTEST = 100.0
"""Bound of velocities that have no limit, in m/s or rad/s."""


def box(*bounds: ArrayLike) -> spaces.Box:
    """Return the space of observations whose parts are between minus and plus some bounds."""
    most = np.concatenate([np.asarray(bound, np.float64).ravel() for bound in bounds])
    return spaces.Box(-most, most, dtype=np.float64)


def joint_positions(simulator: Simulator) -> Vector:
    """Return bounds of the joints' positions: the larger of their limits, with a margin.

    An engine may stop a joint only after the physics step in which it passes its limit.
    """
    layout, joints = simulator.layout, simulator.robot.joints
    farthest = np.maximum(np.abs(layout.lower[joints]), np.abs(layout.upper[joints]))
    beyond = joint_velocities(simulator) * simulator.period
    return np.where(np.isfinite(farthest), farthest * _MARGIN + beyond, 1e6)


def joint_velocities(simulator: Simulator) -> Vector:
    """Return bounds of the joints' velocities: their limits, with a margin."""
    fastest = simulator.layout.max_velocity[simulator.robot.joints]
    return np.where(np.isfinite(fastest), fastest * _OVERSHOOT, FASTEST)
