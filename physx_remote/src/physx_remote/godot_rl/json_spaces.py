"""Spaces, observations and actions in godot-rl's JSON, for both sides of the connection."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ActionError, ConfigError, listed
from physx_remote.serving.spaces import Leaf, Path, Space, SpaceTree, check_shape

IMAGE = "2d"
"""Mark in an image's key; the value is bytes in hexadecimal."""

OBSERVATION, ACTION = "obs", "action"
"""Keys of the values of spaces without parts."""

_PICTURE = "camera_2d"
_LARGEST = sys.float_info.max


def _key(path: Path, root: str) -> str:
    """Return the key of a part: names are joined by dots, numbers by underscores."""
    key = ""
    for step in path:
        if isinstance(step, int):
            key = f"{key or root}_{step}"
        else:
            key = f"{key}.{step}" if key else str(step)
    return key or root


# Services ---------------------------------------------------------------------------------------


class ObservationWriter:
    """Converts observations of a space to JSON data.

    Vectors become lists of numbers; images (arrays of uint8 with three axes) become hexadecimal
    text, and ``_2d`` is appended to keys that do not contain ``2d``. The parts of nested spaces
    become separate entries. A space without parts is the entry ``obs``, or ``camera_2d`` if it is
    an image.

    Attributes:
        description: The entries in ``env_info``.
    """

    def __init__(self, space: Space) -> None:
        """Choose the format of each part."""
        self.description: dict[str, dict[str, Any]] = {}
        self._tree = SpaceTree(space)
        self._writers: list[Callable[[Any], Any]] = []
        for path, leaf in zip(self._tree.paths, self._tree.leaves, strict=True):
            name, entry, write = _describe_observation(_key(path, OBSERVATION), leaf)
            if name in self.description:
                raise ConfigError(f'Two parts of the observation would both be called "{name}".')
            self.description[name] = entry
            self._writers.append(write)

    def write(self, observation: Any) -> dict[str, Any]:
        """Return an observation as JSON data."""
        values = self._tree.split(observation)
        parts = zip(self.description, self._writers, values, strict=True)
        return {name: write(value) for name, write, value in parts}


def _describe_observation(
    name: str, space: Leaf
) -> tuple[str, dict[str, Any], Callable[[Any], Any]]:
    """Return an entry's key, its description, and the function that converts its value."""
    if isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3:
        if IMAGE not in name:
            name = _PICTURE if name == OBSERVATION else f"{name}_{IMAGE}"
        entry = {"space": "box", "size": list(space.shape), "low": 0, "high": 255}
        return name, entry, lambda value: np.ascontiguousarray(value, np.uint8).tobytes().hex()
    if IMAGE in name:
        raise ConfigError(
            f'The part "{name}" of the observation is not an image (uint8 with three axes), but '
            f'godot-rl treats every name with "{IMAGE}" as one. Rename the part.'
        )
    if isinstance(space, spaces.Discrete):
        start = int(space.start)
        return name, {"space": "discrete", "size": int(space.n)}, lambda value: int(value) - start
    shape = space.shape or (1,)
    return name, {"space": "box", "size": list(shape), **_bounds(space)}, _numbers(shape)


def _bounds(space: Any) -> dict[str, float]:
    """Return the common bounds of all components; empty if there are no finite ones."""
    if isinstance(space, spaces.Box):
        if not math.prod(space.shape):
            return {}
        low, high = float(np.min(space.low)), float(np.max(space.high))
    elif isinstance(space, spaces.MultiBinary):
        low, high = 0.0, 1.0
    else:
        low, high = float(np.min(space.start)), float(np.max(space.start + space.nvec - 1))
    return {"low": low, "high": high} if math.isfinite(low) and math.isfinite(high) else {}


def _numbers(shape: tuple[int, ...]) -> Callable[[Any], Any]:
    def write(value: Any) -> Any:
        if type(value) is np.ndarray and value.shape == shape and value.dtype.kind == "f":
            return value.tolist()
        array = np.asarray(value)
        if array.dtype == np.bool_:
            array = array.astype(np.uint8)
        return array.reshape(shape).tolist()

    return write


class ActionReader:
    """Converts actions from JSON to values of a space.

    Continuous actions are between -1 and 1. They are clipped to that range and scaled to the bounds
    of the space; if a bound is infinite, the number itself is the action. Discrete actions are
    numbers from 0. Spaces of several discrete numbers become entries ``NAME_0``, ``NAME_1``, and so
    on; the parts of nested spaces become separate entries. A space without parts is the entry
    ``action``.

    Attributes:
        description: The entries in ``env_info``.
    """

    def __init__(self, space: Space) -> None:
        """Choose the format of each part."""
        self.description: dict[str, dict[str, Any]] = {}
        self._tree = SpaceTree(space)
        self._readers: list[Callable[[Mapping[str, Any]], Any]] = []
        for path, leaf in zip(self._tree.paths, self._tree.leaves, strict=True):
            entries, read = _describe_action(_key(path, ACTION), leaf)
            twice = entries.keys() & self.description.keys()
            if twice:
                raise ConfigError(f"Two parts of the action would both be called {listed(twice)}.")
            self.description.update(entries)
            self._readers.append(read)

    def read(self, given: Any) -> Any:
        """Return one agent's action as a value of the space.

        Args:
            given: Entry to number or list of numbers, from JSON.
        """
        if not isinstance(given, dict) or given.keys() != self.description.keys():
            has = listed(given) if isinstance(given, dict) else type(given).__name__
            raise ActionError(f"an action needs the entries {listed(self.description)}, not {has}.")
        return self._tree.join(read(given) for read in self._readers)


def _describe_action(
    name: str, space: Leaf
) -> tuple[dict[str, Any], Callable[[Mapping[str, Any]], Any]]:
    """Return the descriptions of a part's entries, and the function that reads them."""
    if isinstance(space, spaces.Box):
        entries = {name: {"size": math.prod(space.shape), "action_type": "continuous"}}
        return entries, _continuous(name, space)
    if isinstance(space, spaces.Discrete):
        count, start = int(space.n), int(space.start)
        entries = {name: {"size": count, "action_type": "discrete"}}
        return entries, lambda given: start + _index(name, given[name], count)
    return _several_discrete(name, space)


def _continuous(name: str, space: spaces.Box) -> Callable[[Mapping[str, Any]], Any]:
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    bounded = np.isfinite(low) & np.isfinite(high)
    with np.errstate(invalid="ignore"):
        middle = np.where(bounded, high / 2 + low / 2, 0.0)
        half = np.where(bounded, high / 2 - low / 2, 1.0)
    ends = np.where(bounded, 1.0, np.inf)
    count, whole = math.prod(space.shape), np.issubdtype(space.dtype, np.integer)

    def read(given: Mapping[str, Any]) -> Any:
        numbers = given[name]
        if not isinstance(numbers, list) or len(numbers) != count:
            has = len(numbers) if isinstance(numbers, list) else type(numbers).__name__
            raise ActionError(f'"{name}" takes a list of {count} numbers, not {has}.')
        for index, number in enumerate(numbers):
            if type(number) not in (float, int) or not -_LARGEST <= number <= _LARGEST:
                raise ActionError(f'"{name}"[{index}] is {number!r}, which is not a finite number.')
        unit = np.array(numbers, np.float64).reshape(space.shape)
        value = np.clip(np.clip(unit, -ends, ends) * half + middle, low, high)
        return np.asarray(np.rint(value) if whole else value, space.dtype)

    return read


def _several_discrete(
    name: str, space: spaces.MultiDiscrete | spaces.MultiBinary
) -> tuple[dict[str, Any], Callable[[Mapping[str, Any]], Any]]:
    if isinstance(space, spaces.MultiBinary):
        counts, starts = np.full(space.shape, 2), np.zeros(space.shape, np.int64)
    else:
        counts, starts = np.asarray(space.nvec), np.asarray(space.start)
    sizes = {f"{name}_{i}": int(count) for i, count in enumerate(counts.reshape(-1))}

    def read(given: Mapping[str, Any]) -> Any:
        chosen = [_index(entry, given[entry], count) for entry, count in sizes.items()]
        return (np.array(chosen, np.int64).reshape(counts.shape) + starts).astype(space.dtype)

    return {e: {"size": n, "action_type": "discrete"} for e, n in sizes.items()}, read


def _index(name: str, number: Any, count: int) -> int:
    whole = int(number) if type(number) is float and number.is_integer() else number
    if type(whole) is int and 0 <= whole < count:
        return whole
    raise ActionError(f'"{name}" takes a number from 0 to {count - 1}, not {number!r}.')


# Clients ----------------------------------------------------------------------------------------


def observation_space_of(name: str, entry: Mapping[str, Any]) -> Space:
    """Return the space of an entry of the observations."""
    if entry["space"] == "discrete":
        return spaces.Discrete(int(entry["size"]))
    if entry["space"] != "box":
        raise ValueError(f"unknown space {entry['space']!r}")
    shape = check_shape(int(size) for size in entry["size"])
    if IMAGE in name:
        return spaces.Box(0, 255, shape, np.uint8)
    low, high = entry.get("low", -np.inf), entry.get("high", np.inf)
    return spaces.Box(float(low), float(high), shape, np.float64)


def action_space_of(name: str, entry: Mapping[str, Any]) -> Space:
    """Return the space of an entry of the actions; raises the same as `observation_space_of`."""
    size = int(entry["size"])
    if entry["action_type"] == "discrete":
        return spaces.Discrete(size)
    if entry["action_type"] != "continuous":
        raise ValueError(f"unknown action_type {entry['action_type']!r}")
    return spaces.Box(-1.0, 1.0, check_shape([size]), np.float32)


def read_observation(name: str, space: Space, given: Any) -> Any:
    """Return an entry of an observation as a value of its space."""
    if isinstance(space, spaces.Discrete):
        return np.int64(given)
    if IMAGE in name:
        return np.frombuffer(bytes.fromhex(given), np.uint8).reshape(space.shape or ())
    return np.array(given, np.float64).reshape(space.shape or ())
