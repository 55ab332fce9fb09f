"""Fields: names, shapes, types, and units of a sample's values, and the values that fit them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import DTypeLike

from physx_core import checks
from physx_core.errors import (
    ConfigError,
    FieldShapeError,
    FieldTypeError,
    NotFiniteError,
    nearest,
)
from physx_core.typing import Array

Role: TypeAlias = Literal["training", "additional", "episode"]
ROLES: tuple[Role, ...] = get_args(Role)

RESERVED = ("env_id", "episode", "step")
"""Fields that physx adds to each row: number of the instance, its trajectory, and its step."""

NUMBERS = "biufc"
"""Kinds of NumPy types that fields may have: boolean, integer, floating-point, complex."""

TEXT = "S"
"""Kind of NumPy types of text: UTF-8 in a fixed number of bytes, filled up with zeros."""

_FITTING = {"b": "b", "i": "biu", "u": "biu", "f": "biuf", "c": NUMBERS}
"""Kind of a field's type to the kinds of values that fit it."""

NO_ARRAY = (ValueError, TypeError, OverflowError, RuntimeError)
"""Exceptions of `np.asarray` for values that are ragged or cannot be converted to an array."""

CHANNEL = "channel"
"""Name of the axis whose entries are different quantities, such as the components of a velocity."""

ENDS = "_ends"
"""What is added to the name of a free axis for that of the file where its rows' entries end."""

PTR = "_ptr"
"""What is added to the name of a free axis for that of the first entries of a batch's samples."""

BATCH = "_batch"
"""What is added to the name of a free axis for that of the samples of a batch's entries."""

SIZES = "_sizes"
"""What is added to the name of a free axis of a window for that of its rows' numbers of entries."""

_FREE = 'Values of any size need a free axis, which is defined before: shape=("node", 3)'

_SMALL = 8192  # elements


@dataclass(frozen=True)
class Field:
    """Description of one entry of a sample.

    Attributes:
        name: Name, a Python identifier.
        shape: Shape of one sample's value. None: taken from the first sample. The first axis may
            have a name instead of a size, as in ``("node", 3)``: it is *free*, of any size in each
            sample, the same for all fields with this axis. Its values are *entries*.
        dtype: NumPy type: any plain boolean, integer, floating-point, or complex type, or ``"S16"``
            for text of at most 16 bytes in UTF-8, which is read as bytes.
        unit: Unit of the values, for example ``"N m"``; empty for dimensionless numbers.
        role: ``training`` for data that networks read, ``episode`` for what a whole independent
            episode has once, ``additional`` for everything else.
        axes: Names of the axes of a value, as many as it has, for example ``("channel", "y",
            "x")``; empty if they have none. Statistics of two or more named axes are pooled over
            all but ``"channel"``, so they fit values of any resolution.
        like: Name of the field that is the same quantity, with the same unit: this one is
            normalized by its statistics. Empty: it is a quantity of its own.
        indexes: Name of the free axis whose entries the values are numbers of, from 0 in each
            sample, as the nodes of an edge are: where samples are joined, they are shifted.
        numpy_dtype: The type as a NumPy object.
        free_axis: Name of the free axis; empty if there is none.
        entry_shape: Shape of an entry of the free axis; without one, that of a sample's value.
        nbytes: Size of an entry, or without a free axis a value, in bytes; 0: the shape is unknown.
    """

    name: str
    shape: tuple[Any, ...] | None = None
    dtype: DTypeLike = "float64"
    unit: str = ""
    role: Role = "training"
    axes: tuple[str, ...] = ()
    like: str = ""
    indexes: str = ""
    numpy_dtype: np.dtype[Any] = dataclasses.field(init=False, repr=False, compare=False)
    free_axis: str = dataclasses.field(init=False, repr=False, compare=False)
    entry_shape: tuple[int, ...] = dataclasses.field(init=False, repr=False, compare=False)
    nbytes: int = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the name, and normalize shape and type.

        Raises:
            ConfigError: If the name is not an identifier, the shape is invalid, the type is not a
                plain one, or the axes have other names than identifiers, or too many or too few,
                or an axis other than the first one is free.
        """
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise ConfigError(f"A field's name must be a Python identifier, not {self.name!r}.")
        try:
            dtype = np.dtype(self.dtype)
        except TypeError as error:
            text = f'Field "{self.name}": {self.dtype!r} is not a NumPy type.'
            raise ConfigError(text) from error
        if dtype.kind not in (*NUMBERS, TEXT) or not dtype.itemsize:
            raise ConfigError(
                f'Field "{self.name}" has type {dtype}, which has no fixed plain layout. '
                "Use a boolean, integer, floating or complex type, or for text its largest number "
                'of bytes: "S16".'
            )
        object.__setattr__(self, "dtype", dtype.newbyteorder("<").str)
        if self.shape is not None:
            object.__setattr__(self, "shape", _shape(self.name, self.shape))
        first, *_ = self.shape or (0,)
        free = first if isinstance(first, str) else ""
        entry = (self.shape or ())[1 if free else 0 :]
        count = math.prod(entry) if self.shape is not None else 0
        object.__setattr__(self, "numpy_dtype", np.dtype(self.dtype))
        object.__setattr__(self, "free_axis", free)
        object.__setattr__(self, "entry_shape", entry)
        object.__setattr__(self, "nbytes", count * dtype.itemsize)
        object.__setattr__(self, "axes", _axes(self.name, self.axes, self.shape))
        if not isinstance(self.like, str) or (self.like and not self.like.isidentifier()):
            raise ConfigError(
                f'Field "{self.name}": like is {self.like!r} but must be the name of a field.'
            )
        if self.indexes and (self.numpy_dtype.kind not in "iu" or not self.indexes.isidentifier()):
            raise ConfigError(
                f'Field "{self.name}": indexes is {self.indexes!r} and the type {dtype}, but it '
                "must be the name of a free axis, and the type an integer."
            )

    @cached_property
    def of_entries(self) -> Field:
        """The field of an entry of the free axis; without one, the field itself."""
        if not self.free_axis:
            return self
        return replace(self, shape=self.entry_shape, axes=self.axes[1:])

    @cached_property
    def row_kind(self) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Shape and type of a row in an array of rows, an object with a free axis."""
        return ((), np.dtype(object)) if self.free_axis else (self.entry_shape, self.numpy_dtype)

    @property
    def is_text(self) -> bool:
        """Whether its values are text, as UTF-8."""
        return self.numpy_dtype.kind == TEXT

    @property
    def has_statistics(self) -> bool:
        """Whether it has statistics: floating-point fields do, unless physx adds them."""
        return self.name not in RESERVED and self.numpy_dtype.kind == "f"

    @property
    def pooled(self) -> tuple[int, ...]:
        """The axes of an entry that its statistics are pooled over, besides a free axis.

        Of several named ones, these are all but the channels.
        """
        if len(self.axes) < 2 or not self.shape or 0 in self.shape:
            return ()
        axes = self.axes[1 if self.free_axis else 0 :]
        return tuple(place for place, name in enumerate(axes) if name != CHANNEL)

    @property
    def statistics_shape(self) -> tuple[int, ...]:
        """Shape of its statistics: that of an entry, but 1 for the axes they are pooled over."""
        return self.pooled_shape(self.pooled)

    def pooled_shape(self, axes: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape of an entry, but 1 for some axes."""
        return tuple(1 if i in axes else n for i, n in enumerate(self.entry_shape))

    def is_resolution(self, shape: tuple[int, ...]) -> bool:
        """Return whether a shape differs from its own only in the axes that are `pooled`."""
        own = self.entry_shape
        sizes = enumerate(zip(own, shape, strict=False))
        return len(own) == len(shape) and all(
            here == there or axis in self.pooled for axis, (here, there) in sizes
        )

    def converted_dtype(self, dtype: np.dtype[Any] | None) -> np.dtype[Any]:
        """Return the type of the values if floating-point fields are converted to `dtype`."""
        own = self.numpy_dtype
        return own if dtype is None or own.kind != "f" else dtype

    def convert(self, values: Any, *, axes: int = 0, instance_id: int = 0, step: int = -1) -> Array:
        """Return values as an array of the field's shape and type.

        These rules decide which values fit a field, however they get into a dataset:

        - Booleans, integers, floating-point numbers, and complex numbers fit fields of their own
          kind and of the kinds after it in this list. A number never becomes a boolean, and a
          complex number never becomes real.
        - An integer field stores integers exactly: one that is out of range does not fit.
        - Floating-point and complex fields round to the nearest value of their type, also integers
          (float64 represents all of them up to 2**53). A number that is too large for the type
          becomes infinite, and infinite numbers are rejected when rows are checked: see
          `is_finite`.
        - Text fits a text field that has room for it in UTF-8; bytes do if they are that. It holds
          no zero characters.
        - Byte order and memory layout do not matter. Objects and dates fit no field.
        - An empty list or tuple fits a field of any type.

        Args:
            values: One value or an array of values: numbers, sequences, or arrays.
            axes: Number of axes before the field's own.
            instance_id: Instance that set the values, for the error; 0: unknown.
            step: The instance's step that set them, for the error.

        Returns:
            An array of shape (*first axes, *field shape), with a free axis an array of objects, one
            array for each row. It shares memory with `values` if that is
            an array of the field's type.

        Raises:
            FieldShapeError: If the values are ragged or have another shape.
            FieldTypeError: If the field's type cannot hold the values.
        """
        if self.free_axis and axes:  # rows of any size
            rows = [self.convert(each, instance_id=instance_id, step=step) for each in values]
            return np.fromiter(rows, object, len(rows))
        error: type[FieldShapeError | FieldTypeError] = FieldShapeError
        try:
            array: Array = _as_text(values) if self.is_text else np.asarray(values)
        except ValueError as cause:
            text = f"is ragged or malformed: {cause}. {_FREE}"
        except NO_ARRAY as cause:
            error, text = FieldTypeError, f"is not convertible to an array: {cause}"
        else:
            if array.ndim < axes:
                text = "is a single value; rows have shape (n, *field shape)"
            elif self.shape is not None and not self.is_shape(array.shape[axes:]):
                text = f"has shape {array.shape[axes:]} but is defined as {self.shape}"
            elif self.axes and array.ndim - axes != len(self.axes):
                text = f"has shape {array.shape[axes:]} but the axes {self.axes}"
            else:
                error, (text, array) = FieldTypeError, _fitted(array, self.numpy_dtype, values)
                if not text:
                    return array
        raise error(
            f'field "{self.name}" {text}.', field=self.name, instance_id=instance_id, step=step
        )

    def is_shape(self, shape: tuple[int, ...]) -> bool:
        """Return whether a value may have a shape."""
        if self.free_axis:
            return len(shape) > 0 and shape[1:] == self.entry_shape
        return shape == self.shape

    def not_finite(
        self, *, instance_id: int = 0, step: int = -1, where: str = ""
    ) -> NotFiniteError:
        """Return the error for a value that is NaN or infinite.

        Args:
            instance_id: Instance that set the value; 0: unknown.
            step: The instance's step that set it.
            where: Further description of the location, with a leading space.
        """
        return NotFiniteError(
            f'field "{self.name}" holds NaN or an infinite number as {self.numpy_dtype}{where}.',
            field=self.name,
            instance_id=instance_id,
            step=step,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the field as plain data for JSON or TOML."""
        plain: dict[str, Any] = {"name": self.name, "dtype": self.dtype, "role": self.role}
        if self.shape is not None:
            plain["shape"] = list(self.shape)
        if self.unit:
            plain["unit"] = self.unit
        if self.axes:
            plain["axes"] = list(self.axes)
        if self.like:
            plain["like"] = self.like
        if self.indexes:
            plain["indexes"] = self.indexes
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Field:
        """Return the field that `to_dict` described."""
        shape = plain.get("shape")
        return cls(
            name=plain["name"],
            shape=None if shape is None else tuple(shape),
            dtype=plain["dtype"],
            unit=plain.get("unit", ""),
            role=plain.get("role", "training"),
            axes=tuple(plain.get("axes", ())),
            like=plain.get("like", ""),
            indexes=plain.get("indexes", ""),
        )


def _shape(name: str, given: Any) -> tuple[Any, ...]:
    """Return a shape: a size, or several; the first one may be the name of a free axis."""
    where = f'Field "{name}": shape'
    try:
        sizes = (given,) if isinstance(given, str) else tuple(given)
    except TypeError:
        sizes = (given,)
    free = sizes[:1] if sizes and isinstance(sizes[0], str) else ()
    if free and not free[0].isidentifier():
        raise ConfigError(f"{where} is {given!r}, but a free axis has an identifier as its name.")
    if any(isinstance(size, str) for size in sizes[1:]):
        raise ConfigError(f"{where} is {given!r}, but only the first axis can be free.")
    shape = tuple(checks.integer(where, size) for size in sizes[len(free) :])
    if min(shape, default=0) < 0:
        raise ConfigError(f"{where} is {given!r} but must not be negative.")
    return (*free, *shape)


def _axes(name: str, given: Any, shape: tuple[Any, ...] | None) -> tuple[str, ...]:
    """Return the names of axes: one, or several."""
    try:
        names = (given,) if isinstance(given, str) else tuple(given)
    except TypeError:
        names = (None,)
    where = f'Field "{name}": the axes'
    if not all(isinstance(each, str) and each.isidentifier() for each in names):
        raise ConfigError(f"{where} are {given!r} but must have names that are identifiers.")
    if len(set(names)) < len(names):
        raise ConfigError(f"{where} {names} have the same name twice.")
    if names and shape is not None and len(names) != len(shape):
        raise ConfigError(f"{where} are {names}, but its shape is {shape}: name each of its axes.")
    if names and shape and isinstance(shape[0], str) and names[0] != shape[0]:
        raise ConfigError(f"{where} are {names}, but the first one is free: call it {shape[0]!r}.")
    return names


def ends_fields(fields: Iterable[Field]) -> dict[str, Field]:
    """Return the fields that say where each row's entries end in its partition, by name."""
    names = [axis + ENDS for axis in free_axes(fields)]
    return {name: Field(name, (), "uint64", role="additional") for name in names}


def free_axes(fields: Iterable[Field]) -> dict[str, list[str]]:
    """Return the free axes of fields, each with the names of the fields that have it."""
    found: dict[str, list[str]] = {}
    for field in fields:
        if field.free_axis:
            found.setdefault(field.free_axis, []).append(field.name)
    return found


def check_together(fields: Mapping[str, Field]) -> None:
    """Check what fields say of one another: see `Field.like`, `Field.indexes` and `Field.shape`.

    Args:
        fields: All fields of a mode by name.

    Raises:
        ConfigError: If the field that one is like does not exist or is itself like a third one, or
            they differ in unit, or in a shape that statistics of both could have; if a free axis
            has the name of a field, or an axis is indexed that no field has.
    """
    _check_axes(fields)
    for name, field in fields.items():
        if not field.like:
            continue
        where, other = f'Field "{name}" is like "{field.like}"', fields.get(field.like)
        if other is None:
            raise ConfigError(f"{where}, but there is no such field.{nearest(field.like, fields)}")
        if other.like or other is field:
            raise ConfigError(f'{where}, which is like "{other.like}": name the first of them.')
        if field.unit != other.unit:
            raise ConfigError(f"{where}, but has the unit {field.unit!r}, not {other.unit!r}.")
        if not _is_like(field, other):
            raise ConfigError(
                f"{where}, but has the shape {field.shape}, which neither ends with "
                f'{other.shape} nor has as many entries on a named axis "{CHANNEL}".'
            )


def _check_axes(fields: Mapping[str, Field]) -> None:
    """Check names of free axes, and that indexed ones exist."""
    axes = free_axes(fields.values())
    for axis in axes:
        for name in (axis + suffix for suffix in (ENDS, PTR, BATCH, SIZES)):
            if name in fields:
                raise ConfigError(f'Field "{name}" has a name that belongs to the axis "{axis}".')
    is_known = all(field.shape is not None for field in fields.values())
    for name, field in fields.items():
        if field.indexes and field.indexes not in axes and is_known:
            raise ConfigError(
                f'Field "{name}" indexes the axis "{field.indexes}", but no field has it as a free '
                f"axis.{nearest(field.indexes, axes)}"
            )


def _is_like(field: Field, other: Field) -> bool:
    """Return whether statistics of one field can be those of another one."""
    if field.shape is None or other.shape is None:
        return True
    own, wanted = field.entry_shape, other.entry_shape
    if own[len(own) - len(wanted) :] == wanted:
        return len(own) >= len(wanted)
    return bool(field.axes and other.axes) and _channels(field) == _channels(other)


def _channels(field: Field) -> int | None:
    return (field.shape or ())[field.axes.index(CHANNEL)] if CHANNEL in field.axes else None


FieldLike: TypeAlias = Field | tuple[str, Any] | str
"""A field, its name, or ``(name, type)``; type: a NumPy type, `float`, `int`, `bool`, `ndarray`."""


def as_fields(given: FieldLike | Iterable[FieldLike], role: Role) -> list[Field]:
    """Convert a user's field descriptions to fields of one role.

    Args:
        given: One field or several: a `Field`, a name, or a pair (name, type). The type
            `np.ndarray` means an array of float64 with the shape of the first sample; `float`,
            `int`, and `bool` mean one number.
        role: Role of all the fields.

    Raises:
        ConfigError: If a name is not an identifier or is reserved, or a type is not a plain one.
    """
    single = isinstance(given, (Field, str)) or (
        isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], str)
    )
    items: Iterable[Any] = [given] if single else given  # type: ignore[assignment]
    fields = [_as_field(item, role) for item in items]
    for field in fields:
        if field.name in RESERVED:
            raise ConfigError(f'The field name "{field.name}" is reserved: physx sets this field.')
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
    raise ConfigError(f'{item!r} is not a field. Give Field(...), "name" or ("name", type).')


def is_finite(array: Array) -> bool:
    """Return whether an array contains neither NaN nor infinity."""
    if array.dtype.kind not in "fc":
        return array.dtype.kind != "O" or all(map(is_finite, array))
    # The sum shows it in one fast pass, unless it overflows. For small arrays the dot product is
    # faster; for large ones it would start threads, which costs more than it saves.
    if array.size <= _SMALL:
        total = np.vdot(array, array).real
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            total = abs(np.add.reduce(array, axis=None))
    return math.isfinite(total) or bool(np.isfinite(array).all())


def first_not_finite(rows: Array) -> int | None:
    """Return the index of the first row that contains NaN or infinity; None: no row does."""
    if is_finite(rows):
        return None
    if rows.dtype.kind == "O":
        return next(row for row, value in enumerate(rows) if not is_finite(value))
    finite = np.isfinite(rows).reshape(len(rows), -1).all(axis=1)
    return int(np.argmin(finite))


def _fitted(array: Array, dtype: np.dtype[Any], values: Any) -> tuple[str, Array]:
    """Return why a type cannot hold the given values, empty if it can, and the array of it."""
    if dtype.kind == TEXT:
        return _encoded(array, dtype)
    if array.dtype == dtype:
        return "", array
    text = _misfit(array, dtype)
    if not text or (not array.size and not isinstance(values, np.ndarray)):
        return "", _cast(array, dtype)
    return text, array


def _misfit(array: Array, dtype: np.dtype[Any]) -> str:
    """Return why a type cannot hold the values of an array; empty if it can."""
    kind = array.dtype.kind
    if kind == "O":
        return f"holds objects. {_FREE}"
    if kind not in _FITTING[dtype.kind]:
        return f"holds {array.dtype} but is defined as {dtype}, which cannot hold it"
    if dtype.kind in "iu" and kind != "b" and array.size:
        limits = np.iinfo(dtype)
        extremes = (array.item(),) if array.size == 1 else (int(array.min()), int(array.max()))
        for number in extremes:
            if not limits.min <= number <= limits.max:
                return f"holds {number} but is defined as {dtype}, which cannot hold it"
    return ""


def _as_text(values: Any) -> Array:
    """Return values as an array, strings as objects: NumPy would drop zero characters."""
    array = np.asarray(values)
    return array if array.dtype.kind in TEXT + NUMBERS else np.asarray(values, object)


def is_utf8(array: Array) -> bool:
    """Return whether all bytes of an array of text are UTF-8."""
    try:
        np.char.decode(array, "utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _encoded(array: Array, dtype: np.dtype[Any]) -> tuple[str, Array]:
    """Return why values are no text of a type, empty if they are, and the text in UTF-8."""
    if array.dtype == dtype:
        return "" if is_utf8(array) else "holds bytes that are not UTF-8", array
    found = []
    for value in array.ravel().tolist():
        if not isinstance(value, (str, bytes)):
            return f"holds {value!r:.40} but is defined as text", array
        try:
            text = value.encode() if isinstance(value, str) else value
            text.decode()
        except UnicodeError as error:
            return f"holds {value!r:.40}, which is not UTF-8: {error}", array
        if len(text) > dtype.itemsize:
            room = f"takes {len(text)} bytes in UTF-8; it has room for {dtype.itemsize}"
            return f"holds {value!r:.40}, which {room}", array
        if b"\0" in text:
            return f"holds {value!r:.40}, with a zero character", array
        found.append(text)
    return "", np.array(found, dtype).reshape(array.shape)


def _cast(array: Array, dtype: np.dtype[Any]) -> Array:
    """Convert an array to a type that can hold it; numbers too large for it become infinite."""
    size, given = _real_size(dtype), _real_size(array.dtype)
    if dtype.kind in "fc" and (size < given or size == 2):
        with np.errstate(over="ignore"):
            return array.astype(dtype)
    return array.astype(dtype)


def _real_size(dtype: np.dtype[Any]) -> int:
    """Return the size in bytes of a number of this type, or of each part of a complex number."""
    return dtype.itemsize // 2 if dtype.kind == "c" else dtype.itemsize
