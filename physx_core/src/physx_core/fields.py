"""Fields: the names, shapes, types and units of what a sample holds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import DTypeLike

from physx_core.errors import ConfigError
from physx_core.typing import Array

Role: TypeAlias = Literal["training", "additional"]

RESERVED = ("env_id", "episode", "step")
"""Fields that physx adds to each row: number of the instance, its trajectory, and its step."""

_KINDS = "biufc"

_SMALL = 8192  # elements


@dataclass(frozen=True)
class Field:
    """What one entry of a sample is.

    Attributes:
        name: Name, a Python identifier.
        shape: Shape of one sample's value. None: taken from the first sample.
        dtype: NumPy type, any plain boolean, integer, floating or complex one.
        unit: Unit of the values, for example ``"N m"``; empty for numbers without one.
        role: ``training`` for what networks read, ``additional`` for what is kept beside it.
    """

    name: str
    shape: tuple[int, ...] | None = None
    dtype: DTypeLike = "float64"
    unit: str = ""
    role: Role = "training"

    def __post_init__(self) -> None:
        """Check the name, and bring shape and type to their plain form.

        Raises:
            ConfigError: The name is no identifier, the shape is negative, or the type is not plain.
        """
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise ConfigError(f"A field's name must be a Python identifier, not {self.name!r}.")
        try:
            dtype = np.dtype(self.dtype)
        except TypeError as error:
            raise ConfigError(f'Field "{self.name}": {self.dtype!r} is no NumPy type.') from error
        if dtype.kind not in _KINDS:
            raise ConfigError(
                f'Field "{self.name}" has type {dtype}, which has no fixed plain layout. '
                "Use a boolean, integer, floating or complex type."
            )
        object.__setattr__(self, "dtype", dtype.newbyteorder("<").str)
        if self.shape is not None:
            shape = (self.shape,) if isinstance(self.shape, int) else tuple(self.shape)
            if any(not isinstance(n, (int, np.integer)) or n < 0 for n in shape):
                raise ConfigError(f'Field "{self.name}": {self.shape!r} is no shape.')
            object.__setattr__(self, "shape", tuple(int(n) for n in shape))

    @cached_property
    def nbytes(self) -> int:
        """Bytes of one sample's value; 0 while the shape is unknown."""
        count = math.prod(self.shape) if self.shape is not None else 0
        return count * np.dtype(self.dtype).itemsize

    def to_dict(self) -> dict[str, Any]:
        """Return the field as plain data for JSON or TOML."""
        plain: dict[str, Any] = {"name": self.name, "dtype": self.dtype, "role": self.role}
        if self.shape is not None:
            plain["shape"] = list(self.shape)
        if self.unit:
            plain["unit"] = self.unit
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Field:
        """Make the field that `to_dict` described."""
        shape = plain.get("shape")
        return cls(
            name=plain["name"],
            shape=None if shape is None else tuple(shape),
            dtype=plain["dtype"],
            unit=plain.get("unit", ""),
            role=plain.get("role", "training"),
        )


FieldLike: TypeAlias = Field | tuple[str, Any] | str
"""A field, or ``(name, type)`` with `type` a NumPy type, `float`, `int`, `bool` or `np.ndarray`."""


def as_fields(given: FieldLike | Iterable[FieldLike], role: Role) -> list[Field]:
    """Return what a user gave as fields of one role.

    Args:
        given: One field or several: a `Field`, a name, or a pair (name, type). The type
            `np.ndarray` stands for an array of float64 whose shape the first sample tells;
            `float`, `int` and `bool` stand for one number.
        role: Role that all the fields get.

    Raises:
        ConfigError: A name is no identifier, is reserved or given twice, or a type is not plain.
    """
    single = isinstance(given, (Field, str)) or (
        isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], str)
    )
    items: Iterable[Any] = [given] if single else given  # type: ignore[assignment]
    fields = [_as_field(item, role) for item in items]
    for field in fields:
        if field.name in RESERVED:
            raise ConfigError(f'The field name "{field.name}" is reserved: physx fills it itself.')
    return fields


def _as_field(item: Any, role: Role) -> Field:
    if isinstance(item, Field):
        return replace(item, role=role)
    if isinstance(item, str):
        return Field(item, role=role)
    if isinstance(item, tuple) and len(item) == 2:
        name, kind = item
        if kind is np.ndarray:
            return Field(name, role=role)
        if kind in (float, int, bool):
            return Field(name, shape=(), dtype=kind, role=role)
        return Field(name, dtype=kind, role=role)
    raise ConfigError(f'{item!r} is no field. Give Field(...), "name" or ("name", type).')


def is_finite(array: Array) -> bool:
    """Return whether no value is NaN or infinite."""
    if array.dtype.kind not in "fc":
        return True
    # A sum tells it in one fast pass, unless it overflows. Small arrays take the quicker dot
    # product; for large ones it would start threads, which costs more than it saves.
    if array.size <= _SMALL:
        total = np.vdot(array, array).real
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            total = abs(np.add.reduce(array, axis=None))
    return math.isfinite(total) or bool(np.isfinite(array).all())
