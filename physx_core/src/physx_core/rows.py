"""RowBuffer: a block of rows under construction, one preallocated array for each field."""

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
    SampleError,
    UnknownFieldError,
    listed,
    nearest,
)
from physx_core.fields import Field, is_finite
from physx_core.typing import Array, Batch, Sample

ROW_FIELDS = (
    Field("env_id", shape=(), dtype="int32", role="additional"),
    Field("episode", shape=(), dtype="int64", role="additional"),
    Field("step", shape=(), dtype="int64", role="additional"),
)
"""What physx adds to each row: the instance that made it, the instance's trajectory and step."""


def infer_shapes(fields: Iterable[Field], sample: Mapping[str, Any]) -> list[Field]:
    """Return the fields with their shapes, those yet unknown taken from the first sample."""
    shaped = []
    for field in fields:
        if field.shape is None and field.name in sample:
            with contextlib.suppress(ValueError):  # a ragged value: `RowBuffer.put` names it
                field = replace(field, shape=np.asarray(sample[field.name]).shape)
        shaped.append(field)
    return shaped


def copy_row(batch: Batch, row: int) -> Sample:
    """Return a copy of one row of a batch as a sample, each value an array."""
    return {name: np.array(values[row]) for name, values in batch.items()}


class RowBuffer:
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
            if not is_finite(values):
                self._raise_not_finite(name, values)
        return {name: array[:count] for name, array in self.arrays.items()}

    def is_finite(self, row: int) -> bool:
        """Return whether a row holds neither NaN nor an infinite number."""
        return all(is_finite(self.arrays[name][row]) for name in self._floating)

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


class RejectedSamples:
    """Samples that `check_sample` rejected, in the order of their steps.

    Nothing invalid is ever stored: one that lacks a field, has one of another name, shape or type,
    or holds NaN or an infinite number, is left out.
    """

    def __init__(self) -> None:
        self._waiting: list[tuple[Sample, int, int]] = []

    def note(self, sample: Mapping[str, Any], episode: int, step: int) -> None:
        """Keep a copy of a sample.

        Args:
            sample: Field name to value.
            episode: The instance's trajectory that it belongs to.
            step: The instance's step that made it.
        """
        with contextlib.suppress(ValueError, TypeError):  # it is ragged, or no array at all
            copies = {name: np.array(value) for name, value in sample.items()}
            self._waiting.append((copies, episode, step))

    def shaped(self, fields: Sequence[Field]) -> list[Field]:
        """Return fields with shapes that are open taken from the first sample that has them all."""
        for sample, _, _ in self._waiting:
            if all(field.name in sample for field in fields):
                return infer_shapes(fields, sample)
        return list(fields)

    def take(self, fields: Sequence[Field], instance_id: int) -> Batch:
        """Return the samples as rows, with the fields that physx adds, and forget them.

        Args:
            fields: The environment's fields; where a shape is open no sample fits.
            instance_id: Instance that made the samples.
        """
        waiting, self._waiting = self._waiting, []
        if any(field.shape is None for field in fields):
            waiting = []
        columns, count = RowBuffer(fields, len(waiting)), 0
        for sample, episode, step in waiting:
            with contextlib.suppress(SampleError):
                columns.put(count, sample, instance_id, episode, step)
                count += columns.is_finite(count)
        return columns.rows(count)

    def clear(self) -> None:
        """Forget all samples."""
        self._waiting.clear()


def concatenate(blocks: Sequence[Batch]) -> Batch:
    """Return blocks of rows of the same fields as one; empty where there are no rows."""
    blocks = [block for block in blocks if len(next(iter(block.values()), ()))]
    if not blocks:
        return {}
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


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
