"""Checks of observations against their space."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from physx_gym.shared_arrays import SharedArrays
from physx_gym.spaces import format_path, leaves, value_at
from physx_sim.errors import SimulationError


class ObservationChecks(SharedArrays):
    """Finds NaN in observations of a space, and observations outside the space.

    Attributes:
        space: The space.
        excludes_nan: Whether an observation within the space is free of NaN.
    """

    def __init__(self, space: spaces.Space[Any], flat: NDArray[Any] | None = None) -> None:
        """Prepare for observations of a space.

        Args:
            space: Their space.
            flat: Memory of the only buffer that will be checked, with its leaves in the order of
                the space; None: any observation.
        """
        self.space = space
        self._leaves = list(leaves(space))
        boxes = [each for _, each in self._leaves if isinstance(each, spaces.Box)]
        floating = all(np.issubdtype(each.dtype, np.floating) for each in boxes)
        self._flat, self._is_floating = flat, floating and len(boxes) == len(self._leaves)
        low = np.concatenate([np.ravel(each.low) for each in boxes]) if boxes else np.zeros(0)
        high = np.concatenate([np.ravel(each.high) for each in boxes]) if boxes else np.zeros(0)
        self._low, self._high = low, high
        self._is_bounded = bool(np.isfinite(low).any() or np.isfinite(high).any())
        self.excludes_nan = self._is_floating and self._is_bounded
        self._within = np.empty((2, len(low)), np.bool_)
        self._above, self._below = self._within

    def _vector(self, observation: Any) -> Any:
        """Return all numbers of a floating-point observation as a vector."""
        if self._flat is not None:
            return self._flat
        if type(observation) is np.ndarray:
            return observation if observation.ndim == 1 else observation.ravel()
        return np.concatenate([value_at(observation, path) for path, _ in self._leaves], None)

    def check_finite(self, observation: Any) -> None:
        """Check that there is no NaN."""
        if self._is_floating:
            vector = self._vector(observation)
            total = vector.dot(vector)
            if total == total:
                return
        for path, space in self._leaves:
            part = value_at(observation, path)
            if isinstance(space, spaces.Box) and np.isnan(part).any():
                place = np.argwhere(np.isnan(part))[0].tolist()
                where = format_path((*path, *place))
                raise SimulationError(
                    f"The observation is not a number{' at ' if where else ''}{where}. Look at "
                    "refresh_observation, and at what the simulation measures."
                )

    def is_inside(self, observation: Any) -> bool:
        """Return whether an observation is within its space."""
        if not self._is_floating:
            return bool(self.space.contains(observation))
        if not self._is_bounded:
            return True
        vector = self._vector(observation)
        np.greater_equal(vector, self._low, self._above)
        np.less_equal(vector, self._high, self._below)
        return b"\0" not in self._within.tobytes()  # many times faster than all()

    def describe_outside(self, observation: Any) -> str:
        """Describe the first number of an observation that is outside its space."""
        for path, space in self._leaves:
            part = value_at(observation, path)
            if space.contains(part):
                continue
            if isinstance(space, spaces.Box):
                part = np.asarray(part)
                places = np.argwhere((part < space.low) | (part > space.high))
                if len(places):
                    place = tuple(places[0].tolist())
                    where = format_path((*path, *place))
                    low, high = space.low[place], space.high[place]
                    at = f" at {where}" if where else ""
                    return f"{part[place]:.6g}{at} is not between {low:.6g} and {high:.6g}"
            where = format_path(path)
            return f"{part}{f' at {where}' if where else ''} is not in {space}"
        return "it is not in the space"

    def check_form(self, observation: Any) -> None:
        """Check that an observation has the form of its space, regardless of its values."""
        for path, space in self._leaves:
            try:
                part = value_at(observation, path)
            except (KeyError, IndexError, TypeError):
                raise SimulationError(
                    f"The observation lacks {format_path(path)}, which its space has. Look at "
                    "_initialize_observation_space and refresh_observation."
                ) from None
            array = np.asarray(part)
            if isinstance(space, spaces.Box) and (
                array.shape != space.shape or array.dtype != space.dtype
            ):
                raise SimulationError(
                    f"The observation{' at ' if path else ''}{format_path(path)} is an array of "
                    f"{array.dtype}, shape {array.shape}, but its space says {space.dtype}, "
                    f"{space.shape}. Look at refresh_observation."
                )
