"""Validates values from untrusted files: types, limits, and names that cannot form a path."""

from __future__ import annotations

import re
from typing import Any, TypeVar

from physx_core.fields import ROLES, Field

SESSION = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}")
"""Valid prefix of file names; it cannot form a path."""

_MOST = 2**62
_WIDEST_ROW = 2**40
_MOST_AXES = 32
_LONGEST_NAME = 200

T = TypeVar("T")


def checked(kind: type[T], value: Any, what: str) -> T:
    """Return a value after checking that it has exactly this type."""
    if type(value) is not kind:
        raise ValueError(f"{what} cannot be {value!r:.60}")
    return value


def whole(value: Any, what: str, most: int = _MOST) -> int:
    """Return a value after checking that it is an integer between 0 and `most`."""
    if not 0 <= checked(int, value, what) <= most:
        raise ValueError(f"{what} cannot be {value!r:.60}")
    return int(value)


def parse_field(plain: Any) -> Field:
    """Return the field described by plain data."""
    name, shape, role = parse_name(plain["name"], "a field"), plain.get("shape"), plain["role"]
    if shape is not None:
        if len(checked(list, shape, f"the shape of {name!r}")) > _MOST_AXES:
            raise ValueError(f"the shape of {name!r} cannot be {shape!r:.60}")
        free = shape[:1] if shape and isinstance(shape[0], str) else []
        sizes = [whole(count, f"the shape of {name!r}") for count in shape[len(free) :]]
        shape = (*(parse_name(axis, f"an axis of {name!r}") for axis in free), *sizes)
    if role not in ROLES:
        raise ValueError(f"the role of {name!r} cannot be {role!r:.60}")
    unit = checked(str, plain.get("unit", ""), f"the unit of {name!r}")
    names = checked(list, plain.get("axes", []), f"the axes of {name!r}")
    axes = tuple(parse_name(each, f"an axis of {name!r}") for each in names)
    like = plain.get("like", "") and parse_name(plain["like"], f"what {name!r} is like")
    dtype = checked(str, plain["dtype"], f"the type of {name!r}")
    indexes = plain.get("indexes", "") and parse_name(plain["indexes"], f"what {name!r} indexes")
    field = Field(name, shape, dtype, unit, role, axes, like, indexes)
    if field.nbytes > _WIDEST_ROW:
        raise ValueError(f"the shape of {name!r} cannot be {shape!r:.60}")
    return field


def parse_name(value: Any, what: str) -> str:
    """Return the name of a mode or a field."""
    name = checked(str, value, f"the name of {what}")
    if not name.isidentifier() or len(name) > _LONGEST_NAME:
        raise ValueError(f"the name of {what} cannot be {name!r:.60}")
    return name
