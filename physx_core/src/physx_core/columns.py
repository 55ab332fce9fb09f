"""Columns: a block of rows under construction, one preallocated array for each field."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
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
from physx_core.fields import Array, Batch, Field

ROW_FIELDS = (
    Field("env_id", shape=(), dtype="int32", role="additional"),
    Field("episode", shape=(), dtype="int64", role="additional"),
    Field("step", shape=(), dtype="int64", role="additional"),
)
"""What physx adds to each row: the instance that made it, the instance's trajectory and step."""


def shaped_by(fields: Iterable[Field], sample: Mapping[str, Any]) -> list[Field]:
    """Return the fields with their shapes, those yet unknown taken from the first sample."""
    shaped = []
    for field in fields:
        if field.shape is None and field.name in sample:
            with contextlib.suppress(ValueError):  # a ragged value: `Columns.put` names it
                field = replace(field, shape=np.asarray(sample[field.name]).shape)
        shaped.append(field)
    return shaped


class Columns:
    """Rows of samples, each checked as it is put in; finiteness is checked a block at a time.

    Attributes:
        fields: Fields of the rows, those that physx adds at the end.
        capacity: How many rows fit in.
        arrays: Field name to array of shape (capacity, *field shape).
    """

    def __init__(self, fields: Sequence[Field], capacity: int) -> None:
        """Allocate the arrays.

        Args:
            fields: The environment's fields, all with known shapes.
            capacity: How many rows fit in.
        """
        self.fields = [*fields, *ROW_FIELDS]
        self.capacity = capacity
        self.arrays: Batch = {
            field.name: np.empty((capacity, *(field.shape or ())), field.dtype)
            for field in self.fields
        }
        self._names = {field.name for field in fields}
        self._slots = [
            (field.name, self.arrays[field.name], field.shape, np.dtype(field.dtype))
            for field in fields
        ]
        self._floating = [slot[0] for slot in self._slots if slot[3].kind in "fc"]
        self._env_id, self._step = self.arrays["env_id"], self.arrays["step"]
        self._episode = self.arrays["episode"]

    def put(
        self, row: int, sample: Mapping[str, Any], instance_id: int, episode: int, step: int
    ) -> None:
        """Copy one sample into a row.

        Args:
            row: Row to fill, below `capacity`.
            sample: Field name to value; exactly the environment's fields.
            instance_id: Instance that made the sample.
            episode: The instance's trajectory that the sample belongs to.
            step: The instance's step that made it.

        Raises:
            MissingFieldError: A field is missing.
            UnknownFieldError: A field was not defined.
            FieldShapeError: A value has another shape than its field.
            FieldTypeError: A value's type cannot be stored in its field without changing it.
        """
        if sample.keys() != self._names:
            raise self._names_error(sample, instance_id, step)
        for name, array, shape, dtype in self._slots:
            value = sample[name]
            if type(value) is not np.ndarray or value.shape != shape or value.dtype != dtype:
                value = _converted(name, value, shape, dtype, instance_id, step)
            array[row] = value
        self._env_id[row] = instance_id
        self._episode[row] = episode
        self._step[row] = step

    def rows(self, count: int) -> Batch:
        """Return the first `count` rows as views, valid until rows are put in again.

        Raises:
            NotFiniteError: A row holds NaN or an infinite number; names the first one.
        """
        for name in self._floating:
            values = self.arrays[name][:count]
            if not np.isfinite(values).all():
                self._raise_not_finite(name, values)
        return {name: array[:count] for name, array in self.arrays.items()}

    def _raise_not_finite(self, name: str, values: Array) -> None:
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        row = int(np.argmax(bad))
        raise NotFiniteError(
            f'field "{name}" holds NaN or an infinite number.',
            field=name,
            instance_id=int(self._env_id[row]),
            step=int(self._step[row]),
        )

    def _names_error(
        self, sample: Mapping[str, Any], instance_id: int, step: int
    ) -> MissingFieldError | UnknownFieldError:
        unknown = sorted(sample.keys() - self._names)
        if unknown:
            return UnknownFieldError(
                f'field "{unknown[0]}" was not defined.{nearest(unknown[0], self._names)} '
                f"Defined: {listed(self._names)}.",
                field=unknown[0],
                instance_id=instance_id,
                step=step,
            )
        missing = sorted(self._names - sample.keys())
        return MissingFieldError(
            f'field "{missing[0]}" is missing from the step\'s data. Every field must be given '
            f"in every step: {listed(self._names)}.",
            field=missing[0],
            instance_id=instance_id,
            step=step,
        )


def _converted(
    name: str,
    value: Any,
    shape: tuple[int, ...] | None,
    dtype: np.dtype[Any],
    instance_id: int,
    step: int,
) -> Array:
    """Return a value that is no array of the field's shape and type as one, or raise."""
    error: type[FieldShapeError | FieldTypeError] = FieldShapeError
    try:
        array: Array = np.asarray(value)
    except ValueError:
        text = "is ragged: its parts have different lengths"
    else:
        if array.shape == shape and np.can_cast(array.dtype, dtype, "same_kind"):
            return array
        if array.shape != shape:
            text = f"has shape {array.shape} but is defined as {shape}"
        else:
            text = f"holds {array.dtype} but is defined as {dtype}"
            error = FieldTypeError
    raise error(f'field "{name}" {text}.', field=name, instance_id=instance_id, step=step)
