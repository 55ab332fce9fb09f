"""Actions and observations as buffers: nested containers of arrays that are updated in place."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from physx_core.errors import SimulationError
from physx_gym.env.shared_arrays import SharedArrays


def neutral(space: spaces.Space[Any]) -> Any:
    """Return a new buffer for elements of a space: zeros, or what is nearest to them."""
    if isinstance(space, spaces.Dict):
        return {key: neutral(each) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(neutral(each) for each in space.spaces)
    if isinstance(space, spaces.Box):
        return np.asarray(np.clip(np.zeros(space.shape, space.dtype), space.low, space.high))
    if isinstance(space, spaces.Discrete):
        return np.full((), space.start, space.dtype)
    if isinstance(space, spaces.MultiDiscrete):
        return np.array(space.start, space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape, space.dtype)
    return None


def copied(tree: Any) -> Any:
    """Return a copy of nested containers of arrays."""
    kind = type(tree)
    if kind is dict:
        found = {}
        for key, each in tree.items():
            found[key] = each.copy() if type(each) is np.ndarray else copied(each)
        return found
    if kind in (tuple, list):
        return kind([copied(each) for each in tree])
    return tree.copy() if isinstance(tree, np.ndarray) else tree


def copier(space: spaces.Space[Any]) -> Callable[[Any], Any]:
    """Return what copies buffers as elements of a space: a choice as a number, not as an array."""
    choices = any(isinstance(each, spaces.Discrete) for _, each in leaves(space))
    return partial(_element, space) if choices else copied


def _element(space: spaces.Space[Any], tree: Any) -> Any:
    if isinstance(space, spaces.Dict):
        return {key: _element(each, tree[key]) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_element(*pair) for pair in zip(space.spaces, tree, strict=True))
    if isinstance(space, spaces.Discrete) and isinstance(tree, np.ndarray):
        return tree[()]
    return copied(tree)


def fill(tree: Any, values: Any) -> Any:
    """Write values into nested arrays in place; return the tree, or the value of what is no array.

    Raises:
        SimulationError: They do not have the same form.
    """
    try:
        if isinstance(tree, np.ndarray):
            tree[...] = values
            return tree
        if isinstance(tree, dict):
            for key in tree:
                tree[key] = fill(tree[key], values[key])
            return tree
        if isinstance(tree, (tuple, list)):
            pairs = zip(tree, values, strict=True)
            return type(tree)(fill(each, value) for each, value in pairs)
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise SimulationError(f"These values are of another form: {error}.") from error
    return values


Path = tuple[Any, ...]


def leaves(space: spaces.Space[Any], path: Path = ()) -> list[tuple[Path, spaces.Space[Any]]]:
    """Return the spaces in nested spaces with the keys that lead to them."""
    if isinstance(space, spaces.Dict):
        return [leaf for key in space.spaces for leaf in leaves(space.spaces[key], (*path, key))]
    if isinstance(space, spaces.Tuple):
        return [
            leaf for key, each in enumerate(space.spaces) for leaf in leaves(each, (*path, key))
        ]
    return [(path, space)]


def written(path: Path) -> str:
    """Return keys as they are written in Python, for example ``["states"][0]``."""
    return "".join(f'["{key}"]' if isinstance(key, str) else f"[{key}]" for key in path)


class ObservationChecks(SharedArrays):
    """Finds what is no number in observations of a space, and what is outside of it.

    Attributes:
        space: The space.
        tells_nan: Whether nothing that is inside holds a NaN.
    """

    def __init__(self, space: spaces.Space[Any], flat: NDArray[Any] | None = None) -> None:
        """Prepare for observations of a space.

        Args:
            space: Their space.
            flat: Memory of the one buffer that they all are, its leaves one after the other in the
                order of the space; None: any observation.
        """
        self.space = space
        self._leaves = leaves(space)
        boxes = [each for _, each in self._leaves if isinstance(each, spaces.Box)]
        floating = all(np.issubdtype(each.dtype, np.floating) for each in boxes)
        self._flat, self._even = flat, floating and len(boxes) == len(self._leaves)
        low = np.concatenate([np.ravel(each.low) for each in boxes]) if boxes else np.zeros(0)
        high = np.concatenate([np.ravel(each.high) for each in boxes]) if boxes else np.zeros(0)
        self._low, self._high = low, high
        self._bounded = bool(np.isfinite(low).any() or np.isfinite(high).any())
        self.tells_nan = self._even and self._bounded
        self._within = np.empty((2, len(low)), np.bool_)
        self._above, self._below = self._within

    def _vector(self, observation: Any) -> Any:
        """Return all numbers of an observation, if they are floating, as a vector."""
        if self._flat is not None:
            return self._flat
        if type(observation) is np.ndarray:
            return observation if observation.ndim == 1 else observation.ravel()
        return np.concatenate([_at(observation, path) for path, _ in self._leaves], None)

    def check_finite(self, observation: Any) -> None:
        """Check that there is no NaN.

        Raises:
            SimulationError: There is one; the message says where.
        """
        if self._even:
            vector = self._vector(observation)
            total = vector.dot(vector)
            if total == total:
                return
        for path, space in self._leaves:
            part = _at(observation, path)
            if isinstance(space, spaces.Box) and np.isnan(part).any():
                place = np.argwhere(np.isnan(part))[0].tolist()
                where = written((*path, *place))
                raise SimulationError(
                    f"The observation is not a number{' at ' if where else ''}{where}. Look at "
                    "refresh_observation, and at what the simulation measures."
                )

    def inside(self, observation: Any) -> bool:
        """Return whether an observation is within its space."""
        if not self._even:
            return bool(self.space.contains(observation))
        if not self._bounded:
            return True
        vector = self._vector(observation)
        np.greater_equal(vector, self._low, self._above)
        np.less_equal(vector, self._high, self._below)
        return b"\0" not in self._within.tobytes()  # many times faster than all()

    def check_form(self, observation: Any) -> None:
        """Check that an observation has the form of its space, whatever its values.

        Raises:
            SimulationError: It has another one.
        """
        for path, space in self._leaves:
            try:
                part = _at(observation, path)
            except (KeyError, IndexError, TypeError):
                raise SimulationError(
                    f"The observation lacks {written(path)}, which its space has. Look at "
                    "_initialize_observation_space and refresh_observation."
                ) from None
            array = np.asarray(part)
            if isinstance(space, spaces.Box) and (
                array.shape != space.shape or array.dtype != space.dtype
            ):
                raise SimulationError(
                    f"The observation{' at ' if path else ''}{written(path)} is an array of "
                    f"{array.dtype}, shape {array.shape}, but its space says {space.dtype}, "
                    f"{space.shape}. Look at refresh_observation."
                )


def _at(tree: Any, path: Path) -> Any:
    for key in path:
        tree = tree[key]
    return tree
