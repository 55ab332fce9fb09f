"""Checks blocks of rows before any of them is stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from physx_core.errors import FieldShapeError, FieldTypeError
from physx_core.fields import NO_ARRAY, NUMBERS, RESERVED, Field, first_not_finite
from physx_core.rows import check_names
from physx_core.typing import Batch


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
            raise FieldTypeError(
                f'field "{name}" holds {array.dtype}; only plain numbers can be stored.', field=name
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
    """Return rows as contiguous arrays of the fields' types, and their number.

    Args:
        fields: The fields of the mode; a shape of None is taken from the rows.
        rows: Field name to rows, shape (n, *field shape).
        checked: Whether rows of the fields' types are known to be finite.
    """
    check_names(fields, rows)
    block = {
        name: np.ascontiguousarray(field.convert(rows[name], axes=1))
        for name, field in fields.items()
    }
    lengths = {name: len(array) for name, array in block.items()}
    if len(set(lengths.values())) != 1:
        raise FieldShapeError(f"The fields have different numbers of rows: {lengths}.")
    for name, array in block.items():
        if checked and array is rows[name]:
            continue
        bad = first_not_finite(array)
        if bad is not None:
            raise fields[name].not_finite(where=f" in row {bad} of the block")
    return block, next(iter(lengths.values()))
