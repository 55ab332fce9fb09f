"""Reads log files: everything in a file is validated, and nothing in it is executed."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.parsing import parse_json
from physx_gym.errors import LogError
from physx_gym.telemetry.episode_log import FORMAT, TIME, VERSION, Column, Log

_NAMES_WIDTH = 4096
_CONTACT = 7  # columns of the contacts


def read_log(path: str | Path) -> Log:
    """Read a log file.

    Args:
        path: A file written by `Log.write`: the environment's ``log_path``.

    Raises:
        LogError: If it is missing, damaged, or not a log.
    """
    import h5py

    path = Path(path)
    if not path.is_file():
        raise LogError(f"There is no log {path}.")
    try:
        with h5py.File(path, "r") as file:
            return _Reader(path, file).read()
    except LogError:
        raise
    except (OSError, RuntimeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise LogError(f"{path} cannot be read as a log: {error}.") from error


Source = Log | Mapping[str, Any] | str | Path


def as_logs(sources: Source | Sequence[Source], more: Sequence[Source] = ()) -> list[Log]:
    """Return logs, their files, or values of `RobotEnv.log_data`, as logs.

    Args:
        sources: One or several.
        more: Any number of further ones.
    """
    several = isinstance(sources, Sequence) and not isinstance(sources, str)
    given: Any = sources if several else [sources]
    logs = [_log(each) for each in (*given, *more)]
    if not logs:
        raise LogError("No log was given: pass at least one.")
    return logs


def _log(source: Any) -> Log:
    if isinstance(source, (str, Path)):
        return read_log(source)
    if isinstance(source, Mapping):
        source = Log(source.get("constants", {}), source.get("variables", {}))
    if not isinstance(source, Log):
        raise LogError(f"{source!r} is neither a log nor log_data nor the path of a log.")
    if not len(source.variables.get(TIME, ())):
        raise LogError("Nothing was recorded: no episode has run yet. Call reset and step first.")
    return source


class _Reader:
    """Reads one open file."""

    def __init__(self, path: Path, file: Any) -> None:
        self._path, self._file = path, file
        self._size = path.stat().st_size

    def read(self) -> Log:
        """Return the log."""
        if self._file.attrs.get("format") != FORMAT:
            raise self._error("is not a log of physx")
        version = self._file.attrs.get("version")
        if version != VERSION:
            raise self._error(f"has the version {version}; this physx reads version {VERSION}")
        constants = parse_json(self._values(self._file, "constants", "u1", 1).tobytes())
        if not isinstance(constants, dict):
            raise self._error("has constants that are not a dictionary")
        variables: dict[str, Column] = {}
        units: dict[str, str] = {}
        for dtype in ("float64", "int64"):
            if dtype in self._file:
                self._table(dtype, variables, units)
        if next(iter(variables), None) != TIME:
            raise self._error("does not start with the time column")
        if len({len(each) for each in variables.values()}) != 1:
            raise self._error("has columns of different lengths")
        apart: dict[str, Any] = {"units": units}
        if "contacts" in self._file:
            apart["contacts"] = self._values(self._file, "contacts", "float64", 2)
            if apart["contacts"].shape[1] != _CONTACT:
                raise self._error(f"has contacts of {apart['contacts'].shape[1]} numbers")
        return Log({**constants, **apart}, variables, self._path)

    def _table(self, dtype: str, variables: dict[str, Column], units: dict[str, str]) -> None:
        """Read the columns of one type."""
        group = self._item(self._file, dtype)
        values = self._values(group, "values", dtype, 2)
        names, own = (self._texts(group, name) for name in ("names", "units"))
        if not len(names) == len(own) == values.shape[1]:
            raise self._error(f"has {values.shape[1]} columns of {dtype} but {len(names)} names")
        if len(set(names)) != len(names) or set(names) & set(variables):
            raise self._error("has two columns of the same name")
        variables |= {name: values[:, number] for number, name in enumerate(names)}
        units |= {name: unit for name, unit in zip(names, own, strict=True) if unit}

    def _item(self, group: Any, name: str) -> Any:
        """Return a member of a group; links are not followed."""
        import h5py

        if not isinstance(group, h5py.Group) or name not in group:
            raise self._error(f'lacks "{name}"')
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise self._error(f'has a link instead of "{name}"')
        return group[name]

    def _values(self, group: Any, name: str, dtype: str | None, axes: int) -> Any:
        """Return a dataset that is contiguous within this file.

        This way, nothing is decompressed, and nothing larger than the file is allocated.
        """
        import h5py

        item = self._item(group, name)
        if not isinstance(item, h5py.Dataset) or item.shape is None or item.ndim != axes:
            raise self._error(f'has no {axes}-dimensional array "{name}"')
        if dtype is not None and item.dtype != np.dtype(dtype):
            raise self._error(f'has numbers of type {item.dtype} in "{name}"')
        if item.chunks is not None or item.is_virtual or item.external:
            raise self._error(f'does not store "{name}" contiguously')
        needed, offset = item.size * item.dtype.itemsize, item.id.get_offset()
        if needed and (offset is None or offset + needed > self._size):
            raise self._error(f'is truncated: "{name}" is incomplete')
        return item[()]

    def _texts(self, group: Any, name: str) -> list[str]:
        texts = self._values(group, name, None, 1)
        if texts.dtype.kind != "S" or texts.dtype.itemsize > _NAMES_WIDTH:
            raise self._error(f'has no strings in "{name}"')
        return [text.decode() for text in texts.tolist()]

    def _error(self, what: str) -> LogError:
        return LogError(f"{os.fspath(self._path)} cannot be read: it {what}.")
