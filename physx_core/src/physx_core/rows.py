"""Rows of samples: buffers that check each row when it is added, and rejected samples."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from physx_core.errors import (
    MissingFieldError,
    SampleError,
    UnknownFieldError,
    listed,
    nearest,
)
from physx_core.fields import NO_ARRAY, Field, first_not_finite, is_finite
from physx_core.packing import check_sizes
from physx_core.typing import Array, Batch, Sample

ROW_FIELDS = (
    Field("env_id", shape=(), dtype="int32", role="additional"),
    Field("episode", shape=(), dtype="int64", role="additional"),
    Field("step", shape=(), dtype="int64", role="additional"),
)
"""Fields that physx adds to each row: the instance that generated it, and the instance's trajectory
and step."""

_BLOCK_NBYTES = 2**20
_BLOCK_ROWS = 4096
_ENTRIES = 256
"""How many entries of a free axis a row may have, to choose the size of blocks."""


class RowBuffer:
    """Rows of samples, one preallocated array for each field; each row is checked once.

    Names, shapes, and types are checked when a row is added. Whether its values are finite is
    checked then as well, or by `take` for all rows together, which is faster.

    Attributes:
        fields: Fields of the rows; those that physx adds come last.
        capacity: Maximum number of rows.
        count: Number of rows.
    """

    def __init__(
        self, fields: Sequence[Field], capacity: int | None = None, *, numbered: bool = True
    ) -> None:
        """Allocate the arrays.

        Args:
            fields: Fields of the samples; one with an open shape takes single numbers.
            capacity: Maximum number of rows; None: as many as fit in 1 MiB, at most 4096.
            numbered: Whether rows get the `ROW_FIELDS` in addition to the samples' fields.
        """
        self.fields = [*fields, *ROW_FIELDS] if numbered else list(fields)
        if capacity is None:
            row_nbytes = sum(
                field.nbytes * (_ENTRIES if field.free_axis else 1) for field in self.fields
            )
            capacity = max(1, min(_BLOCK_ROWS, _BLOCK_NBYTES // max(1, row_nbytes)))
        self.capacity = capacity
        self.count = 0
        self._finite = 0  # number of rows known to be finite
        self._arrays, self._blocks = _allocate(self.fields, capacity)
        self._names = {field.name for field in fields}
        known = [field if field.shape is not None else replace(field, shape=()) for field in fields]
        self._slots = [
            (field.name, self._arrays[field.name], field.shape, field.numpy_dtype, field)
            for field in known
        ]
        is_free = any(field.free_axis for field in known)
        self._free = {
            field.name: field for field in known if is_free and (field.free_axis or field.indexes)
        }
        self._floating = [
            (field, array) for _, array, _, dtype, field in self._slots if dtype.kind in "fc"
        ]
        # A memoryview writes a number in half the time an array takes.
        self._numbers = [self._arrays[field.name].data for field in ROW_FIELDS if numbered]

    @property
    def full(self) -> bool:
        """Whether there is no space for another row."""
        return self.count == self.capacity

    def put(
        self,
        sample: Mapping[str, Any],
        instance_id: int = 0,
        episode: int | None = 0,
        step: int = -1,
        *,
        finite: bool = False,
    ) -> None:
        """Copy a sample into the next row; after an error the buffer is unchanged.

        Args:
            sample: Field name to value, for exactly the fields that the buffer was created with.
            instance_id: Instance that generated the sample; 0: unknown.
            episode: The instance's trajectory that the sample belongs to; None: `number_rows` sets
                what physx adds.
            step: The instance's step that generated it.
            finite: Whether to check now that all values are finite; otherwise `take` does.

        Raises:
            MissingFieldError: If a field is missing.
            UnknownFieldError: If a field was not defined.
            FieldShapeError: If a value's shape differs from that of its field.
            FieldTypeError: If the field's type cannot hold a value: see `Field.convert`.
            NotFiniteError: If `finite` is set and a value is NaN, infinite, or too large for its
                field's type.
        """
        row = self.count
        if len(sample) != len(self._slots):
            check_names(self._names, sample, instance_id, step)
        for name, array, shape, dtype, field in self._slots:
            try:
                value = sample[name]
            except KeyError:
                check_names(self._names, sample, instance_id, step)
                raise
            if type(value) is not np.ndarray or value.dtype is not dtype or value.shape != shape:
                value = field.convert(value, instance_id=instance_id, step=step)
                value = np.array(value) if field.free_axis else value  # the row holds it, no copy
            if finite and not is_finite(value):
                raise field.not_finite(instance_id=instance_id, step=step)
            array[row] = value
        if self._free:
            values = {name: self._arrays[name][row] for name in self._free}
            check_sizes(self._free, values, instance_id, step)
        if self._numbers and episode is not None:
            env_ids, episodes, steps = self._numbers
            env_ids[row] = instance_id
            episodes[row] = episode
            steps[row] = step
        if finite and self._finite == row:
            self._finite = row + 1
        if not row:
            _warn_of_equal(sample)
        self.count = row + 1

    def number_rows(self, first: int, episode: int) -> None:
        """Number rows from one to the last one, each of which is an episode of its own.

        Args:
            first: The first of the rows.
            episode: Number of its episode.
        """
        for name, value in (("env_id", 0), ("step", 0)):
            self._arrays[name][first : self.count] = value
        numbers = np.arange(episode, episode + self.count - first)
        self._arrays["episode"][first : self.count] = numbers

    def take(self) -> Batch:
        """Return the rows as views, valid until the next `put`, and empty the buffer.

        Raises:
            NotFiniteError: If a row contains NaN or infinity; it names the first such row. The rows
                before it can then still be taken.
        """
        count = self.count
        if count < self.capacity or self._finite:
            self._check_finite()
            self.clear()
            return {name: array[:count] for name, array in self._arrays.items()}
        for block in self._blocks:
            if not is_finite(block):
                self._check_finite()
        self.count = 0
        return self._arrays.copy()

    def _check_finite(self) -> None:
        """Check the rows that are not known to be finite."""
        count, wrong = self.count, None
        for field, array in self._floating if self._finite < count else ():
            bad = first_not_finite(array[self._finite : count])
            if bad is not None:
                count, wrong = self._finite + bad, field
        if wrong is not None:
            instance_id, step = 0, -1
            if self._numbers:
                instance_id, step = self._numbers[0][count], self._numbers[2][count]
            self.count = self._finite = count
            raise wrong.not_finite(instance_id=instance_id, step=step)

    def remove(self, first: int, size: int, count: int) -> None:
        """Remove rows of the first `count`, which then are what the buffer holds.

        Args:
            first: The first one to remove.
            size: How many.
            count: How many rows there are, after an error of `take` as well.
        """
        self.count, self._finite = count - size, min(self._finite, first)
        for array in self._arrays.values():
            array[first : self.count] = array[first + size : count]

    def clear(self) -> None:
        """Discard all rows."""
        self.count = self._finite = 0


def _allocate(fields: Sequence[Field], capacity: int) -> tuple[Batch, list[Array]]:
    """Allocate an array for each field; those of the same floating-point type share a block.

    Args:
        fields: Fields of the rows.
        capacity: Maximum number of rows.

    Returns:
        Field name to array, and the blocks, which show in one pass whether all rows are finite.
    """
    shapes = {field.name: (capacity, *field.row_kind[0]) for field in fields}
    arrays = {field.name: np.empty(shapes[field.name], field.row_kind[1]) for field in fields}
    floating = {field.name for field in fields if field.numpy_dtype.kind in "fc"}
    blocks = [arrays[n] for n in arrays if n in floating and arrays[n].dtype.hasobject]
    for dtype in {array.dtype for array in arrays.values() if array.dtype.kind in "fc"}:
        names = [name for name, array in arrays.items() if array.dtype == dtype]
        ends = np.cumsum([arrays[name].size for name in names])
        block = np.zeros(ends[-1], dtype)
        blocks.append(block)
        for name, part in zip(names, np.split(block, ends[:-1]), strict=True):
            arrays[name] = part.reshape(shapes[name])
    return arrays, blocks


class RejectedSamples:
    """Samples that `check_sample` rejected, in the order of their steps.

    Nothing invalid is ever stored: a sample that does not fit the fields, or that contains NaN or
    infinity, is left out.

    Attributes:
        waiting: The samples, their trajectories and steps.
    """

    def __init__(self) -> None:
        self.waiting: list[tuple[Sample, int, int]] = []

    def add(self, sample: Mapping[str, Any], episode: int, step: int) -> None:
        """Keep a copy of a sample.

        Args:
            sample: Field name to value.
            episode: The instance's trajectory that it belongs to.
            step: The instance's step that generated it.
        """
        with contextlib.suppress(*NO_ARRAY):
            copies = {name: np.array(value) for name, value in sample.items()}
            self.waiting.append((copies, episode, step))

    def has(self, episode: int, count: int) -> bool:
        """Return whether the last `count` samples are of an episode."""
        return len(self.waiting) >= count and self.waiting[-count][1] == episode

    def __len__(self) -> int:
        """Return how many samples there are."""
        return len(self.waiting)

    def infer_shapes(self, fields: Sequence[Field]) -> list[Field]:
        """Fill in open shapes of fields from the first sample that has all the fields."""
        for sample, _, _ in self.waiting:
            if all(field.name in sample for field in fields):
                return infer_shapes(fields, sample)
        return list(fields)

    def take(self, fields: Sequence[Field], instance_id: int, keep: int | None = None) -> Batch:
        """Return the samples as rows, with the fields that physx adds, and discard them.

        Args:
            fields: The environment's fields; no sample fits while a shape is open.
            instance_id: Instance that generated the samples.
            keep: Episode whose samples stay; None: there is none.
        """
        waiting = [each for each in self.waiting if each[1] != keep]
        self.waiting = [each for each in self.waiting if each[1] == keep]
        if any(field.shape is None for field in fields):
            waiting = []
        buffer = RowBuffer(fields, len(waiting))
        for sample, episode, step in waiting:
            with contextlib.suppress(SampleError):
                buffer.put(sample, instance_id, episode, step, finite=True)
        return buffer.take()


def _warn_of_equal(sample: Mapping[str, Any]) -> None:
    """Warn of fields that are one array, such as a state before and after a step in place."""
    found: dict[tuple[Any, ...], str] = {}
    for name, value in sample.items():
        if type(value) is np.ndarray and value.size:
            key = value.ctypes.data, value.shape, value.strides
            other = found.setdefault(key, name)
            if other != name:
                warnings.warn(
                    f'The fields "{other}" and "{name}" are the same array, so their values are '
                    "equal. If one is from before a step that changes the array in place, give a "
                    "copy: array.copy().",
                    stacklevel=2,
                )


def check_names(
    expected: Collection[str], given: Collection[str], instance_id: int = 0, step: int = -1
) -> None:
    """Check that exactly the expected fields are given.

    Args:
        expected: Names of the defined fields.
        given: Names of the fields that have values.
        instance_id: Instance that set the values, for the error; 0: unknown.
        step: The instance's step that set them, for the error.

    Raises:
        UnknownFieldError: If a field was not defined.
        MissingFieldError: If a field is missing.
    """
    unknown = sorted(str(name) for name in given if name not in expected)
    if unknown:
        raise UnknownFieldError(
            f'field "{unknown[0]}" was not defined.{nearest(unknown[0], expected)} '
            f"Defined: {listed(expected)}.",
            field=unknown[0],
            instance_id=instance_id,
            step=step,
        )
    missing = sorted(name for name in expected if name not in given)
    if missing:
        raise MissingFieldError(
            f'field "{missing[0]}" is missing. Every field must be given: {listed(expected)}.',
            field=missing[0],
            instance_id=instance_id,
            step=step,
        )


def infer_shapes(fields: Iterable[Field], values: Mapping[str, Any], axes: int = 0) -> list[Field]:
    """Return the fields with open shapes filled in from values.

    Args:
        fields: The fields.
        values: Field name to value.
        axes: Number of axes of the values before the field's own: 1 for rows.
    """
    known = []
    for field in fields:
        if field.shape is None and field.name in values:
            with contextlib.suppress(*NO_ARRAY):  # `RowBuffer.put` reports the field
                field = replace(field, shape=np.asarray(values[field.name]).shape[axes:])
        known.append(field)
    return known


def copy_row(batch: Batch, row: int) -> Sample:
    """Return a copy of one row of a batch as a sample, each value an array."""
    return {name: np.array(values[row]) for name, values in batch.items()}


def concatenate(blocks: Sequence[Batch]) -> Batch:
    """Join blocks of rows with the same fields; empty if there are no rows."""
    blocks = [block for block in blocks if len(next(iter(block.values()), ()))]
    if not blocks:
        return {}
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}
