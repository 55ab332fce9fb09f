"""Converts worlds and options to JSON-compatible data, and back without executing any of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import PhysxError
from physx_gym.errors import LogError
from physx_sim import (
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
"""Classes that make up a world's description, by name."""
_KIND = "kind"
_DEPTH = 32


def to_plain(value: Any) -> Any:
    """Return nested data as dictionaries, lists, strings and numbers.

    A dataclass becomes a dictionary of its fields, with its class as ``kind``; any other object
    becomes its ``repr``. Paths of robots and meshes become absolute.
    """
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
        if isinstance(value, Robot):
            fields["urdf"] = _absolute(value.urdf)
            fields["package_dirs"] = {k: Path(v).absolute() for k, v in value.package_dirs.items()}
        elif isinstance(value, Mesh):
            fields["path"] = Path(value.path).absolute()
        return {
            _KIND: _kind(type(value)),
            **{name: to_plain(each) for name, each in fields.items()},
        }
    if isinstance(value, Mapping):
        return {str(key): to_plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [to_plain(each) for each in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    return repr(value)


def _absolute(urdf: str | Path) -> str | Path:
    """Return the absolute path of a URDF file; a robot's name is returned unchanged."""
    path = Path(urdf)
    is_path = isinstance(urdf, Path) or path.suffix.lower() == ".urdf" or path.is_file()
    return path.absolute() if is_path else urdf


def _kind(kind: type) -> str:
    """Return the name of a class, or of the description class that it is derived from."""
    known = [each.__name__ for each in kind.__mro__ if each in _KINDS.values()]
    return known[0] if known else kind.__name__


def world_of(value: Any, where: str, folder: Path | None = None) -> World:
    """Return the world that `to_plain` described.

    Args:
        value: The plain data.
        where: Where the data is from, for error messages.
        folder: Where to look for files that are no longer at their paths.
    """
    try:
        world = _build(value, _DEPTH, folder)
    except (PhysxError, TypeError, ValueError, KeyError, RecursionError) as error:
        raise LogError(f"The log {where} describes an invalid world: {error}") from error
    if not isinstance(world, World):
        raise LogError(f"The log {where} does not describe a world.")
    return world


def _build(value: Any, depth: int, folder: Path | None) -> Any:
    """Return the descriptions that nested data represents; lists become tuples."""
    if depth == 0:
        raise ValueError("the data is nested too deeply.")
    if isinstance(value, Mapping):
        found = {key: _build(each, depth - 1, folder) for key, each in value.items()}
        if _KIND not in found:
            return found
        name = found.pop(_KIND)
        if name not in _KINDS:
            raise ValueError(f"unknown kind {name!r}.")
        for key in {"urdf", "path"} & found.keys():
            found[key] = _located(found[key], folder)
        known = {each.name for each in dataclasses.fields(_KINDS[name])}
        return _KINDS[name](**{key: each for key, each in found.items() if key in known})
    if isinstance(value, (list, tuple)):
        return tuple(_build(each, depth - 1, folder) for each in value)
    return value


def _located(path: Any, folder: Path | None) -> Any:
    """Return a file's path, or that of a file of the same name in a folder if it is only there."""
    if folder is None or not isinstance(path, str) or Path(path).is_file():
        return path
    if not Path(path).suffix:  # a robot's name
        return path
    beside = folder / Path(path).name
    return str(beside) if beside.is_file() else path
