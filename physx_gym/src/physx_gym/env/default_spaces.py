"""Default spaces and observation of an environment: the motors' torques and all measurements."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.typing import Vector
from physx_gym.simulator.simulator import Simulator
from physx_gym.spaces import leaves, neutral, value_at

_MARGIN = 0.01
"""How far the space extends beyond the limits of positions, as a fraction of their range."""
_FAR = 1e9
"""Bound of unlimited values: engines fail beyond it, and Gymnasium warns about infinite bounds."""


def action_space_of(simulator: Simulator) -> spaces.Box:
    """Return the space of the torques that the motors can exert."""
    most = np.minimum(simulator.max_commands(), _FAR)
    return spaces.Box(-most, most, dtype=np.float64)


def observation_space_of(simulator: Simulator, longest: float) -> spaces.Dict:
    """Return the space of the measurements: time, state of the robot, sensors by kind.

    Args:
        simulator: The simulator.
        longest: Time by which every episode is over, in s.
    """
    inside: dict[str, spaces.Space[Any]] = {
        "t": spaces.Box(0.0, longest, (), np.float64),
        "states": spaces.Dict({"agent": spaces.Dict(_state(simulator))}),
    }
    sensors = {kind: _unbounded(array) for kind, array in simulator.sensed.items()}
    if sensors:
        inside["measurements"] = spaces.Dict(sensors)
    return spaces.Dict(inside)


def _state(simulator: Simulator) -> dict[str, spaces.Space[Any]]:
    part, layout = simulator.robot, simulator.layout
    lower, upper = layout.lower[part.joints], layout.upper[part.joints]
    spread = upper - lower
    margin = _MARGIN * np.where(np.isfinite(spread), spread, 0.0)
    low, high = np.maximum(lower - margin, -_FAR), np.minimum(upper + margin, _FAR)
    if part.floating:
        low = np.concatenate([[-_FAR] * 3, [-1.0 - _MARGIN] * 4, low])
        high = np.concatenate([[_FAR] * 3, [1.0 + _MARGIN] * 4, high])
    velocities = _unbounded(simulator.robot_state.v)
    return {"q": spaces.Box(low, high, dtype=np.float64), "v": velocities}


def _unbounded(array: Vector) -> spaces.Space[Any]:
    return spaces.Box(-_FAR, _FAR, array.shape, np.float64)


def allocate_observation(simulator: Simulator) -> tuple[Any, Vector, dict[str, Any]]:
    """Allocate a buffer for the default observation.

    Returns:
        The index of each observed number in the simulator's values; the memory of the observation,
        flat and in the order of its space; and the observation, which consists of views of that.
    """
    space = observation_space_of(simulator, 1.0)
    numbers = simulator.views_of(np.arange(len(simulator.values), dtype=np.float64))
    places = [np.ravel(value_at(numbers, path)) for path, _ in leaves(space)]
    index = np.concatenate(places).astype(np.intp)
    flat, begin = simulator.values[index], 0
    observation = neutral(space)
    for path, box in leaves(space):
        end = begin + int(np.prod(box.shape or ()))
        *parents, key = path
        value_at(observation, parents)[key] = flat[begin:end].reshape(box.shape or ())
        begin = end
    return index, flat, observation
