"""Checks and clips actions, and writes them into a buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from physx_core.errors import ActionError
from physx_gym.shared_arrays import SharedArrays
from physx_gym.spaces import Path, fill, format_path


class ActionBuffer(SharedArrays):
    """A buffer for actions of a space."""

    def __init__(self, space: spaces.Space[Any], buffer: Any) -> None:
        self._space, self._buffer = space, buffer
        vector = isinstance(buffer, np.ndarray) and buffer.ndim == 1
        self._floating = vector and np.issubdtype(buffer.dtype, np.floating)
        self._dtype = np.dtype(buffer.dtype) if vector else None
        self._bounds = _bounds(space) if isinstance(space, spaces.Box) else None
        self._first = self._end = 0
        if isinstance(space, spaces.Discrete):
            self._first, self._end = int(space.start), int(space.start + space.n)

    def write(self, action: Any) -> None:
        """Check an action, clip it to the bounds of its space, and write it into the buffer."""
        buffer = self._buffer
        kind = type(action)
        if kind is np.int64 or kind is int:
            if self._first <= action < self._end:
                buffer[()] = action
                return
        elif (
            self._floating
            and kind is np.ndarray
            and action.shape == buffer.shape
            and action.dtype is self._dtype
        ):
            total = action.dot(action)
            if total < np.inf:  # all entries are finite
                if self._bounds is None:
                    buffer[:] = action
                else:
                    np.maximum(action, self._bounds[0], out=buffer)
                    np.minimum(buffer, self._bounds[1], out=buffer)
                return
        self._buffer = _write(self._space, buffer, action, ())


def _write(space: spaces.Space[Any], buffer: Any, action: Any, path: Path) -> Any:
    """Write an action into a buffer; return the buffer, or the action if there is none."""
    if isinstance(space, spaces.Dict):
        if not isinstance(action, dict) or set(action) != set(space.spaces):
            keys = list(action) if isinstance(action, dict) else repr(action)
            raise _error(path, f"needs the keys {list(space.spaces)}, not {keys}")
        for key, each in space.spaces.items():
            buffer[key] = _write(each, buffer[key], action[key], (*path, key))
        return buffer
    if isinstance(space, spaces.Tuple):
        if not isinstance(action, (tuple, list)) or len(action) != len(space.spaces):
            raise _error(path, f"needs {len(space.spaces)} parts, not {action!r}")
        parts = zip(space.spaces, buffer, action, strict=True)
        return tuple(_write(*part, (*path, i)) for i, part in enumerate(parts))
    if isinstance(space, spaces.Box):
        _write_box(space, buffer, action, path)
        return buffer
    try:
        known = space.contains(action)
    except Exception:  # spaces may raise anything for values they do not contain
        known = False
    if not known:
        raise _error(path, f"is {action!r}, which is not an element of {space}")
    return fill(buffer, action)


def _write_box(space: spaces.Box, buffer: Any, action: Any, path: Path) -> None:
    try:
        given = np.asarray(action)
    except (TypeError, ValueError, RuntimeError) as error:
        raise _error(path, f"is not an array of numbers: {error}") from error
    if given.shape != space.shape:
        raise _error(path, f"has the shape {given.shape} but needs {space.shape}")
    kinds = "fiu" if np.issubdtype(space.dtype, np.floating) else "iu"
    if given.dtype.kind not in kinds:
        raise _error(path, f"has the type {given.dtype}, which {space.dtype} cannot hold")
    if given.dtype.kind == "f":
        broken = np.isnan(given) | (
            np.isinf(given) & np.isinf(np.where(given > 0, space.high, space.low))
        )
        if broken.any():
            place = tuple(np.argwhere(broken)[0].tolist())
            raise _error((*path, *place), f"is {given[place]}, not a finite number")
    bounds = _bounds(space)
    if bounds is None:
        np.copyto(buffer, given, "same_kind")
    else:
        np.maximum(given, bounds[0], out=buffer, casting="same_kind")
        np.minimum(buffer, bounds[1], out=buffer)


def _bounds(space: spaces.Box) -> tuple[Any, Any] | None:
    limited = np.isfinite(space.low).any() or np.isfinite(space.high).any()
    return (space.low, space.high) if limited else None


def _error(path: Path, what: str) -> ActionError:
    entry = format_path(path)
    return ActionError(f"The action{entry and ' at '}{entry} {what}. See env.action_space.", entry)
