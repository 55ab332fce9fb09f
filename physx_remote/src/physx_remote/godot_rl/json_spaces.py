"""Spaces, observations and actions as godot-rl writes them in JSON."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ActionError, ConfigError, listed
from physx_remote.serving.spaces import Leaf, Space, join, leaves

IMAGE = "2d"
"""What the key of an image contains: its value is the hexadecimal text of bytes."""

OBSERVATION, ACTION = "obs", "action"
"""Keys of what is no part of anything."""

_PICTURE = "camera_2d"
_LARGEST = sys.float_info.max


def _named_leaves(space: Space, root: str) -> Iterator[tuple[str, tuple[Any, ...], Leaf]]:
    """Yield name, path and space of each part; the names of a path are joined with dots."""
    for path, leaf in leaves(space):
        name = ""
        for step in path:
            if isinstance(step, int):
                name = f"{name or root}_{step}"
            else:
                name = f"{name}.{step}" if name else str(step)
        yield name or root, path, leaf


class Observations:
    """Writes observations of a space.

    Vectors become lists of numbers; images, which are arrays of uint8 with three axes, become
    hexadecimal text, and their keys get the ending ``_2d`` where they do not contain ``2d``. The
    parts of nested spaces become entries of their own. One space without parts is the entry
    ``obs``, or ``camera_2d`` if it is an image.

    Attributes:
        described: What ``env_info`` tells of the entries.
    """

    def __init__(self, space: Space) -> None:
        """Choose how to write each part.

        Raises:
            ConfigError: Two parts would get the same name, or one a name that godot-rl misreads.
            UsageError: godot-rl has nothing for a part of the space.
        """
        self.described: dict[str, dict[str, Any]] = {}
        self._writers: list[tuple[str, tuple[Any, ...], Callable[[Any], Any]]] = []
        for part, path, leaf in _named_leaves(space, OBSERVATION):
            name, described, write = _observed(part, leaf)
            if name in self.described:
                raise ConfigError(f'Two parts of the observation would both be called "{name}".')
            self.described[name] = described
            self._writers.append((name, path, write))

    def plain(self, observation: Any) -> dict[str, Any]:
        """Return an observation as data for JSON."""
        told = {}
        for name, path, write in self._writers:
            value = observation
            for step in path:
                value = value[step]
            told[name] = write(value)
        return told


def _observed(name: str, space: Leaf) -> tuple[str, dict[str, Any], Callable[[Any], Any]]:
    """Return an entry's key, its description, and what writes its value."""
    if isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3:
        if IMAGE not in name:
            name = _PICTURE if name == OBSERVATION else f"{name}_{IMAGE}"
        described = {"space": "box", "size": list(space.shape), "low": 0, "high": 255}
        return name, described, lambda value: np.ascontiguousarray(value, np.uint8).tobytes().hex()
    if IMAGE in name:
        raise ConfigError(
            f'The observation\'s part "{name}" has a name with "{IMAGE}", by which godot-rl knows '
            "images, but it is no array of uint8 with three axes. Give it another name."
        )
    if isinstance(space, spaces.Discrete):
        start = int(space.start)
        return name, {"space": "discrete", "size": int(space.n)}, lambda value: int(value) - start
    shape = space.shape or (1,)
    return name, {"space": "box", "size": list(shape), **_bounds(space)}, _numbers(shape)


def _bounds(space: Any) -> dict[str, float]:
    """Return the bounds of all components, if there are any."""
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


class Actions:
    """Reads actions of a space.

    Continuous actions travel between -1 and 1. They are cut to that, and brought to the bounds of
    the space; where a bound is infinite the number itself is the action. Discrete actions travel
    as numbers from 0. Spaces of several discrete numbers become entries ``NAME_0``, ``NAME_1`` and
    so on; the parts of nested spaces become entries of their own. One space without parts is the
    entry ``action``.

    Attributes:
        described: What ``env_info`` tells of the entries.
    """

    def __init__(self, space: Space) -> None:
        """Choose how to read each part.

        Raises:
            ConfigError: Two parts would get the same name.
            UsageError: godot-rl has nothing for a part of the space.
        """
        self.described: dict[str, dict[str, Any]] = {}
        self._space = space
        self._readers: list[Callable[[Mapping[str, Any]], Any]] = []
        for name, _, leaf in _named_leaves(space, ACTION):
            described, read = _acted(name, leaf)
            twice = described.keys() & self.described.keys()
            if twice:
                raise ConfigError(f"Two parts of the action would both be called {listed(twice)}.")
            self.described.update(described)
            self._readers.append(read)

    def read(self, given: Any) -> Any:
        """Return one agent's action as its environment takes it.

        Args:
            given: Entry to number or list of numbers, as JSON gave them.

        Raises:
            ActionError: An entry is missing, unknown, or not what its description says.
        """
        if not isinstance(given, dict) or given.keys() != self.described.keys():
            has = listed(given) if isinstance(given, dict) else type(given).__name__
            raise ActionError(
                f"an action has the entries {listed(self.described)}, and this one: {has}."
            )
        return join(self._space, (read(given) for read in self._readers))


def _acted(name: str, space: Leaf) -> tuple[dict[str, Any], Callable[[Mapping[str, Any]], Any]]:
    """Return the descriptions of a part's entries, and what reads them."""
    if isinstance(space, spaces.Box):
        described = {name: {"size": math.prod(space.shape), "action_type": "continuous"}}
        return described, _continuous(name, space)
    if isinstance(space, spaces.Discrete):
        count, start = int(space.n), int(space.start)
        described = {name: {"size": count, "action_type": "discrete"}}
        return described, lambda given: start + _index(name, given[name], count)
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
                raise ActionError(f'"{name}"[{index}] is {number!r}, which is no finite number.')
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

    described = {e: {"size": n, "action_type": "discrete"} for e, n in sizes.items()}
    return described, read


def _index(name: str, number: Any, count: int) -> int:
    whole = int(number) if type(number) is float and number.is_integer() else number
    if type(whole) is int and 0 <= whole < count:
        return whole
    raise ActionError(f'"{name}" takes a number from 0 to {count - 1}, not {number!r}.')
