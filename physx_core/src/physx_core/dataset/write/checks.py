"""Checking rows before anything of them is stored."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from physx_core.errors import (
    FieldShapeError,
    FieldTypeError,
    MissingFieldError,
    NotFiniteError,
    UnknownFieldError,
    listed,
    nearest,
)
from physx_core.fields import RESERVED, Field, is_finite
from physx_core.typing import Array, Batch


def infer_fields(arrays: Mapping[str, Any]) -> list[Field]:
    """Return the fields that arrays of rows belong to.

    Args:
        arrays: Field name to rows, shape (n, *field shape).

    Raises:
        FieldTypeError: A value is no array of numbers.
        FieldShapeError: A value has no sample axis, or is ragged.
    """
    fields = []
    for name, values in arrays.items():
        array = _as_rows(name, values)
        if array.dtype.kind not in "biufc":
            raise FieldTypeError(
                f'Field "{name}" holds {array.dtype}; only plain numbers can be stored.', field=name
            )
        role = "additional" if name in RESERVED else "training"
        fields.append(Field(name, array.shape[1:], array.dtype, role=role))  # type: ignore[arg-type]
    return fields


def check_rows(fields: Mapping[str, Field], arrays: Mapping[str, Any]) -> tuple[Batch, int]:
    """Return rows as contiguous arrays of the fields' types, and how many there are.

    Args:
        fields: The fields of the mode; a shape of None takes what the rows have.
        arrays: Field name to rows, shape (n, *field shape).

    Raises:
        SampleError: A field is missing, unknown, of another shape, type or length, or not finite.
    """
    check_names(fields, arrays)
    rows: Batch = {}
    for name, field in fields.items():
        array = _as_rows(name, arrays[name])
        shape = array.shape[1:] if field.shape is None else field.shape
        rows[name] = np.ascontiguousarray(convert(name, array, shape, np.dtype(field.dtype), 1))
    lengths = {name: len(array) for name, array in rows.items()}
    if len(set(lengths.values())) != 1:
        raise FieldShapeError(f"The fields have different numbers of rows: {lengths}.")
    for name, array in rows.items():
        if not is_finite(array):
            bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
            raise _not_finite(name, f" in row {int(np.argmax(bad))} of the block")
    return rows, next(iter(lengths.values()))


def check_names(expected: Collection[str], given: Collection[str]) -> None:
    """Check that exactly the expected fields are given.

    Raises:
        UnknownFieldError: One was not defined.
        MissingFieldError: One is missing.
    """
    for name in given:
        if name not in expected:
            raise UnknownFieldError(
                f'Field "{name}" was not defined.{nearest(name, expected)} '
                f"Defined: {listed(expected)}.",
                field=name,
            )
    for name in expected:
        if name not in given:
            raise MissingFieldError(
                f'Field "{name}" is missing. Every field must be given: {listed(expected)}.',
                field=name,
            )


def convert(
    name: str, array: Array, shape: tuple[int, ...], dtype: np.dtype[Any], axes: int
) -> Array:
    """Return values in a field's type, if that keeps what they are.

    Args:
        name: Name of the field.
        array: The values.
        shape: Shape that the field wants.
        dtype: Type that the field wants.
        axes: How many axes of the array come before the field's own.

    Raises:
        FieldShapeError: The shape is another one.
        FieldTypeError: The type cannot hold the values.
    """
    if array.shape[axes:] != shape:
        raise FieldShapeError(
            f'Field "{name}" has shape {array.shape[axes:]} but is defined as {shape}.', field=name
        )
    if array.dtype == dtype:
        return array
    fits = np.can_cast(array.dtype, dtype, "same_kind")
    if fits:
        with np.errstate(over="ignore"):
            converted = array.astype(dtype)
        fits = dtype.kind not in "iu" or bool((converted == array).all())
    if not fits:
        raise FieldTypeError(
            f'Field "{name}" holds {array.dtype} but is defined as {dtype}, which cannot hold it.',
            field=name,
        )
    return converted


def _as_rows(name: str, values: Any) -> Array:
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise FieldShapeError(f'Field "{name}" is ragged: {error}.', field=name) from error
    if not array.ndim:
        raise FieldShapeError(
            f'Field "{name}" is a single value; rows have shape (n, *field shape).', field=name
        )
    return array


def _not_finite(name: str, where: str) -> NotFiniteError:
    return NotFiniteError(f'Field "{name}" holds NaN or an infinite number{where}.', field=name)


class RowBuffer:
    """Single samples on their way to the dataset, checked as they come.

    Attributes:
        count: How many samples wait.
    """

    def __init__(self, fields: Mapping[str, Field], nbytes: int = 2**20, rows: int = 4096) -> None:
        """Allocate space for as many rows as fit into `nbytes`, one at least and `rows` at most.

        Args:
            fields: The fields, with known shapes.
            nbytes: Bytes to hold.
            rows: Most rows to hold.
        """
        row_nbytes = sum(field.nbytes for field in fields.values())
        self.count = 0
        self._capacity = max(1, min(rows, nbytes // max(1, row_nbytes)))
        self._arrays = {
            name: np.empty((self._capacity, *(field.shape or ())), field.dtype)
            for name, field in fields.items()
        }
        self._slots = [
            (name, array, array.shape[1:], array.dtype) for name, array in self._arrays.items()
        ]

    @property
    def full(self) -> bool:
        """Whether no further sample fits in."""
        return self.count == self._capacity

    def put(self, sample: Mapping[str, Any]) -> None:
        """Add one sample.

        Raises:
            SampleError: The sample cannot be stored; the buffer is as it was.
        """
        if sample.keys() != self._arrays.keys():
            check_names(self._arrays, sample)
        row = self.count
        for name, array, shape, dtype in self._slots:
            value = sample[name]
            if type(value) is not np.ndarray or value.dtype != dtype or value.shape != shape:
                value = _as_value(name, value, shape, dtype)
            if not is_finite(value):
                raise _not_finite(name, "")
            array[row] = value
        self.count = row + 1

    def take(self) -> Batch:
        """Return the waiting samples, valid until the next `put`, and forget them."""
        count, self.count = self.count, 0
        return {name: array[:count] for name, array in self._arrays.items()}


def _as_value(name: str, value: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise FieldShapeError(f'Field "{name}" is ragged: {error}.', field=name) from error
    return convert(name, array, shape, dtype, 0)
