"""Worlds and options as plain data that fits into JSON, and back, without running anything."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import PhysxError
from physx_core.errors import LogError
from physx_core.simulation import (
    Box,
    Capsule,
    Cylinder,
    Ground,
    HeightField,
    JointSettings,
    Mesh,
    Robot,
    Sphere,
    Stairs,
    World,
    Wrench,
)

_KINDS = {
    kind.__name__: kind
    for kind in (
        *(World, Robot, JointSettings, Wrench, Ground, HeightField, Stairs),
        *(Box, Capsule, Cylinder, Mesh, Sphere),
    )
}
"""Descriptions that a world consists of, by name."""
_KIND = "kind"
_DEPTH = 32


def plain(value: Any) -> Any:
    """Return nested data as dictionaries, lists, texts and numbers.

    A dataclass is a dictionary of its fields with its class as ``kind``; what is none of these is
    its ``repr``.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
        return {_KIND: _kind(type(value)), **{name: plain(each) for name, each in fields.items()}}
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(each) for each in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    return repr(value)


def _kind(kind: type) -> str:
    """Return the name of a class, or of the world's description that it is a subclass of."""
    known = [each.__name__ for each in kind.__mro__ if each in _KINDS.values()]
    return known[0] if known else kind.__name__


def world_of(value: Any, where: str) -> World:
    """Return the world that `plain` described.

    Args:
        value: What it returned.
        where: Where it is from, for errors.

    Raises:
        LogError: It describes no world, or one that cannot be.
    """
    try:
        world = _made(value, _DEPTH)
    except (PhysxError, TypeError, ValueError, KeyError, RecursionError) as error:
        raise LogError(f"The world in the log {where} makes no sense: {error}") from error
    if not isinstance(world, World):
        raise LogError(f"The log {where} does not say what world it is of.")
    return world


def _made(value: Any, depth: int) -> Any:
    """Return the descriptions that nested data stand for; lists become tuples."""
    if depth == 0:
        raise ValueError("it is nested too deeply.")
    if isinstance(value, Mapping):
        found = {key: _made(each, depth - 1) for key, each in value.items()}
        if _KIND not in found:
            return found
        name = found.pop(_KIND)
        if name not in _KINDS:
            raise ValueError(f"nothing is called {name!r}.")
        known = {each.name for each in dataclasses.fields(_KINDS[name])}
        return _KINDS[name](**{key: each for key, each in found.items() if key in known})
    if isinstance(value, (list, tuple)):
        return tuple(_made(each, depth - 1) for each in value)
    return value
