"""Making a manifest from plain data that nothing is known of: every value is checked."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.fields import Field
from physx_core.statistics import RunningStatistics

SESSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}")
"""What can begin the names of files; no path can be made of it."""

_MOST = 2**62
_WIDEST_ROW = 2**40
_MOST_AXES = 32
_LONGEST_NAME = 200
_ROLES = ("training", "additional")


def manifest_of(plain: Mapping[str, Any]) -> Manifest:
    """Return the manifest that plain data of format version 1 describe.

    Raises:
        ValueError: A value is not possible; says which.
        KeyError: A value is missing.
        ConfigError: A field is not valid.
    """
    modes = {_name(name, "a mode"): _mode(mode) for name, mode in table(plain, "modes").items()}
    versions = {
        _text(name, "a package"): _text(version, "a version")
        for name, version in table(plain, "versions").items()
    }
    return Manifest(modes, table(plain, "info"), versions)


def whole(value: Any, what: str, most: int = _MOST) -> int:
    """Return a whole number between 0 and `most`.

    Raises:
        ValueError: It is none.
    """
    if type(value) is not int or not 0 <= value <= most:
        raise ValueError(f"{what} cannot be {value!r:.60}")
    return value


def table(plain: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return an entry that is a table.

    Raises:
        ValueError: It is something else.
    """
    value = plain[key]
    if not isinstance(value, dict):
        raise ValueError(f"{key!r} cannot be {value!r:.60}")
    return value


def _mode(plain: Any) -> Mode:
    fields: dict[str, Field] = {}
    for entry in plain["fields"]:
        field = _field(entry)
        if field.name in fields:
            raise ValueError(f"the field {field.name!r} is there twice")
        fields[field.name] = field
    if not fields:
        raise ValueError("a mode has no fields")
    mode = Mode(
        fields,
        [_partition(entry, fields) for entry in plain["partitions"]],
        dropped=[_partition(entry, fields) for entry in plain.get("dropped", ())],
    )
    keys = [partition.key for partition in (*mode.partitions, *mode.dropped)]
    if len(set(keys)) != len(keys):
        raise ValueError("a partition is there twice")
    whole(mode.rows, "the number of rows")
    _add_statistics(mode, table(plain, "normalization"))
    return mode


def _field(plain: Any) -> Field:
    name, shape = _name(plain["name"], "a field"), plain.get("shape")
    if shape is not None:
        if not isinstance(shape, list) or len(shape) > _MOST_AXES:
            raise ValueError(f"the shape of {name!r} cannot be {shape!r:.60}")
        shape = tuple(whole(count, f"the shape of {name!r}") for count in shape)
    role = plain["role"]
    if role not in _ROLES:
        raise ValueError(f"the role of {name!r} cannot be {role!r:.60}")
    unit = _text(plain.get("unit", ""), f"the unit of {name!r}")
    field = Field(name, shape, _text(plain["dtype"], f"the type of {name!r}"), unit, role)
    if math.prod(shape or ()) * np.dtype(field.dtype).itemsize > _WIDEST_ROW:
        raise ValueError(f"the shape of {name!r} cannot be {shape!r:.60}")
    return field


def _partition(plain: Any, fields: Mapping[str, Field]) -> Partition:
    session = _text(plain["session"], "a session")
    if not SESSION.fullmatch(session):
        raise ValueError(f"a session cannot be {session!r:.60}")
    sealed = plain["sealed"]
    if type(sealed) is not bool:
        raise ValueError(f"'sealed' cannot be {sealed!r:.60}")
    offsets = {
        _known(name, fields): whole(place, "an offset")
        for name, place in table(plain, "offsets").items()
    }
    checksums = {
        _known(name, fields): int(_text(crc, "a checksum"), 16)
        for name, crc in plain.get("crc32", {}).items()
    }
    if sealed and (len(offsets) != len(fields) or len(checksums) not in (0, len(fields))):
        raise ValueError("a sealed partition lacks offsets or checksums")
    if sealed and any(field.shape is None for field in fields.values()):
        raise ValueError("a sealed partition has fields of unknown shape")
    rows = whole(plain["rows"], "a number of rows") if sealed else 0
    for name, place in offsets.items():
        whole(place + rows * fields[name].nbytes, "the end of the rows")
    return Partition(
        session=session,
        index=whole(plain["index"], "the number of a partition", 2**31),
        first_row=whole(plain["first_row"], "a first row"),
        rows=rows,
        sealed=sealed,
        offsets=offsets,
        checksums=checksums,
        counted=sealed and plain.get("counted") is True,
    )


def _add_statistics(mode: Mode, plain: Mapping[str, Any]) -> None:
    """Give a mode its statistics, if they cover the partitions that are marked as counted."""
    counted = sum(partition.rows for partition in mode.partitions if partition.counted)
    for name, values in plain.items():
        field = mode.fields[_known(name, mode.fields)]
        whole(values["count"], f"the count of {name!r}")
        components = {}
        for key in values.keys() - {"count"}:
            array = np.asarray(values[key], np.float64)
            if field.shape is not None and not array.size and 0 in field.shape:
                array = array.reshape(field.shape)  # JSON loses the shape of empty arrays
            if array.shape != field.shape or not np.isfinite(array).all():
                raise ValueError(f"the normalization of {name!r} has a {key} that cannot be")
            components[key] = array
        mode.statistics[name] = RunningStatistics.from_dict({**values, **components})
    have = (mode.statistics.get(name) for name in mode.counted_fields)
    if any((statistics.count if statistics else 0) != counted for statistics in have):
        mode.forget_statistics()


def _name(value: Any, what: str) -> str:
    name = _text(value, what)
    if not name.isidentifier() or len(name) > _LONGEST_NAME:
        raise ValueError(f"the name of {what} cannot be {name!r:.60}")
    return name


def _known(name: str, fields: Mapping[str, Field]) -> str:
    if name not in fields:
        raise ValueError(f"there is no field {name!r:.60}")
    return name


def _text(value: Any, what: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{what} cannot be {value!r:.60}")
    return value
