"""Checks blocks of rows before any of them is stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np

from physx_core.errors import FieldShapeError, FieldTypeError
from physx_core.fields import ENDS, NO_ARRAY, NUMBERS, RESERVED, Field, first_not_finite
from physx_core.packing import check_sizes, join
from physx_core.rows import check_names
from physx_core.typing import Array, Batch

_DTYPE, _SHAPE = attrgetter("dtype"), attrgetter("shape")


def infer_fields(values: Mapping[str, Any], axes: int = 1) -> list[Field]:
    """Return the fields that describe values.

    Args:
        values: Field name to value.
        axes: Number of axes before the field's own: 1 for rows, 0 for a sample.
    """
    fields = []
    for name, value in values.items():
        role = "additional" if name in RESERVED else "training"
        try:
            array = np.asarray(value)
        except NO_ARRAY:
            array = Field(name).convert(value)  # reports what is wrong
        if array.dtype.kind not in NUMBERS:
            text = (
                " Text needs a field with its largest number of bytes, defined before: "
                f'Field("{name}", (), "S16").'
            )
            raise FieldTypeError(
                f'field "{name}" holds {array.dtype}; only plain numbers can be stored.'
                f"{text if array.dtype.kind in 'SU' else ''}",
                field=name,
            )
        field = Field(name, dtype=array.dtype, role=role)  # type: ignore[arg-type]
        fields.append(replace(field, shape=field.convert(array, axes=axes).shape[axes:]))
    return fields


def count_rows(fields: Mapping[str, Field], rows: Mapping[str, Any]) -> int | None:
    """Return the number of rows if they are contiguous arrays of exactly the fields' types.

    Args:
        fields: The fields of the mode.
        rows: Field name to rows.

    Returns:
        The number; None if the rows must be converted, or are wrong.
    """
    count = None
    for name, field in fields.items():
        array = rows.get(name)
        if (
            type(array) is not np.ndarray
            or array.dtype is not field.numpy_dtype
            or array.shape[1:] != field.shape
            or not array.flags.c_contiguous
        ):
            return None
        if count is None:
            count = len(array)
        elif count != len(array):
            return None
    return count if len(rows) == len(fields) else None


def check_rows(
    fields: Mapping[str, Field], rows: Mapping[str, Any], *, checked: bool = False
) -> tuple[Batch, int]:
    """Return rows as contiguous arrays of the fields' types, as they are stored, and their number.

    With free axes, these have the entries of all rows, and for each axis where those of each row
    end.

    Args:
        fields: The fields of the mode; a shape of None is taken from the rows.
        rows: Field name to rows, shape (n, *field shape); with a free axis, n arrays.
        checked: Whether rows of the fields' types are known to be finite.
    """
    check_names(fields, rows)
    free = {name: field for name, field in fields.items() if field.free_axis}
    several = {name: _converted(field, rows[name]) for name, field in free.items()}
    block = {
        name: np.ascontiguousarray(field.convert(rows[name], axes=1))
        for name, field in fields.items()
        if name not in free
    }
    lengths = {name: len(array) for name, array in (block | several).items()}
    if len(set(lengths.values())) != 1:
        raise FieldShapeError(f"The fields have different numbers of rows: {lengths}.")
    for name, array in block.items():
        if checked and array is rows[name]:
            continue
        bad = first_not_finite(array)
        if bad is not None:
            raise fields[name].not_finite(where=f" in row {bad} of the block")
    count = next(iter(lengths.values()))
    if not free:
        return block, count
    joined = _joined(free, several, checked=checked)
    if not checked and not _fit(fields, block | joined):
        for row in range(count):  # to name it
            check_sizes(fields, {n: values[row] for n, values in (block | several).items()})
    return block | joined, count


def _converted(field: Field, rows: Any) -> list[Array]:
    """Return rows of a field with a free axis, each as an array of its type."""
    given = list(rows)
    if set(map(type, given)) == {np.ndarray} and set(map(_DTYPE, given)) == {field.numpy_dtype}:
        shapes = set(map(_SHAPE, given))
        if all(len(shape) and shape[1:] == field.entry_shape for shape in shapes):
            return given
    return [field.convert(value) for value in given]


def _fit(fields: Mapping[str, Field], block: Batch) -> bool:
    """Return whether all numbers of entries are of some that there are."""
    for name, field in fields.items():
        if not field.indexes:
            continue
        sizes: Any = np.diff(block[field.indexes + ENDS].astype(np.intp), prepend=0)
        if field.free_axis:
            counts: Any = np.diff(block[field.free_axis + ENDS].astype(np.intp), prepend=0)
            sizes = np.repeat(sizes, counts)
        values = block[name]
        sizes = sizes.reshape(-1, *(1,) * (values.ndim - 1))
        if ((values < 0) | (values >= sizes)).any():
            return False
    return True


def stored_form(fields: Mapping[str, Field], rows: Batch) -> Batch:
    """Return checked rows as they are stored: see `check_rows`."""
    free = {name: field for name, field in fields.items() if field.free_axis}
    if not free:
        return rows
    fixed = {name: rows[name] for name in fields if name not in free}
    return fixed | _joined(free, {name: list(rows[name]) for name in free}, checked=True)


def _joined(free: Mapping[str, Field], rows: Mapping[str, list[Array]], *, checked: bool) -> Batch:
    """Return the entries of rows with free axes end to end, and the end of each row's entries."""
    entries: Batch = {}
    ends: Batch = {}
    for name, field in free.items():
        entries[name], counts = join(field, rows[name])
        if not checked and (bad := first_not_finite(entries[name])) is not None:
            row = int(np.cumsum(counts).searchsorted(bad, "right"))
            raise field.not_finite(where=f" in row {row} of the block")
        end = np.cumsum(counts, dtype="<u8")
        first = ends.setdefault(field.free_axis + ENDS, end)
        if first is not end and not np.array_equal(first, end):
            row = int(np.argmax(end != first))
            check_sizes(free, {each: values[row] for each, values in rows.items()})
    return entries | ends
