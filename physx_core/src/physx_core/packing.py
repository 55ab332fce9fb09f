"""Packing: samples of free axes end to end, as they are stored and as graph networks read them.

In an array of rows, a field with a free axis is an array of objects, one array for each row.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from physx_core.errors import FieldShapeError
from physx_core.fields import BATCH, PTR, SIZES, Field
from physx_core.typing import Array, Batch, Index

_LONG = 100  # entries of a sample from which filling a slice is faster


def split(values: Array, counts: Index) -> Array:
    """Return entries row by row, as an array of objects of shape (rows,).

    Args:
        values: The entries of all rows, end to end.
        counts: Number of entries of each row.
    """
    ends = np.cumsum(counts).tolist()
    starts = [0, *ends[:-1]]
    parts = (values[start:end] for start, end in zip(starts, ends, strict=True))
    return np.fromiter(parts, object, len(ends))


def lengths(rows: Sequence[Array] | Array) -> Index:
    """Return the number of entries of each row."""
    return np.fromiter(map(len, rows), np.intp, len(rows))


def join(field: Field, rows: Sequence[Array]) -> tuple[Array, Index]:
    """Return the entries of rows end to end, and how many each has.

    Args:
        field: The field.
        rows: One array for each row, of its type.
    """
    counts = lengths(rows)
    buffers: Any = rows
    try:
        content = bytearray().join(buffers)  # NumPy would copy entry by entry
    except TypeError:  # not contiguous
        buffers = [np.ascontiguousarray(row) for row in rows]
        content = bytearray().join(buffers)
    entries = np.frombuffer(content, field.numpy_dtype) if content else np.empty(0, field.dtype)
    return entries.reshape(int(counts.sum()), *field.entry_shape), counts


def ranges(starts: Index, counts: Index) -> Index:
    """Return the numbers in ranges from some numbers on, one after another."""
    found: Index = (starts - counts.cumsum() + counts).repeat(counts)
    found += np.arange(len(found))
    return found


def copy_ranges(rows: Array, starts: Index, counts: Index, out: Array) -> None:
    """Copy rows in ranges from some numbers on, one after another, into an array of their type.

    They are copied as bytes, by slices of memory, which cost less than those of arrays.

    Args:
        rows: Contiguous rows of at least one byte.
        starts: First number of each range.
        counts: Number of rows of each range.
        out: A contiguous array of as many rows as all ranges have.
    """
    size, end = out.nbytes // len(out), 0
    source, target = (each.reshape(-1).view(np.uint8).data for each in (rows, out))
    for start, count in zip((starts * size).tolist(), (counts * size).tolist(), strict=True):
        begin, end = end, end + count
        target[begin:end] = source[start : start + count]


def check_sizes(
    fields: Mapping[str, Field], sample: Mapping[str, Array], instance_id: int = 0, step: int = -1
) -> None:
    """Check the sizes of a sample's free axes, and numbers of their entries.

    Args:
        fields: The fields by name.
        sample: Their values, each of its field's shape and type.
        instance_id: Instance that set the values, for the error; 0: unknown.
        step: The instance's step that set them, for the error.

    Raises:
        FieldShapeError: If fields that share a free axis have different sizes there, or one numbers
            entries that there are not.
    """
    sizes: dict[str, tuple[int, str]] = {}
    for name, field in fields.items():
        if not field.free_axis:
            continue
        size, other = sizes.setdefault(field.free_axis, (len(sample[name]), name))
        if size != len(sample[name]):
            raise FieldShapeError(
                f'field "{name}" has {len(sample[name])} entries on the axis "{field.free_axis}", '
                f'but "{other}" has {size}.',
                field=name,
                instance_id=instance_id,
                step=step,
            )
    for name, field in fields.items():
        values = sample[name] if field.indexes in sizes else ()
        if len(np.shape(values)) and not np.size(values):
            continue
        size = sizes[field.indexes][0] if field.indexes else 0
        if field.indexes and not 0 <= np.min(values) <= np.max(values) < size:
            raise FieldShapeError(
                f'field "{name}" numbers entries of the axis "{field.indexes}" from '
                f"{np.min(values)} to {np.max(values)}, but there are {size}, from 0.",
                field=name,
                instance_id=instance_id,
                step=step,
            )


class Scratch:
    """Arrays of batches that are reused, each as long as the longest so far."""

    def __init__(self) -> None:
        self._known: dict[str, Array] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
        """Return an array of a shape, valid until the next one with this name."""
        found = self._known.get(name)
        if found is None or len(found) < shape[0]:
            found = self._known[name] = np.empty((shape[0] * 5 // 4, *shape[1:]), dtype)
        return found[: shape[0]]


def _samples_of(ptr: Index, out: Array) -> Array:
    """Return the sample of each entry."""
    ends = ptr.tolist()
    if len(out) < _LONG * len(ends):
        return np.repeat(np.arange(len(ends) - 1), np.diff(ptr))
    for sample, (start, end) in enumerate(itertools.pairwise(ends)):
        out[start:end] = sample
    return out


def pack(
    fields: Mapping[str, Field],
    rows: Mapping[str, Any],
    known: Mapping[str, Index],
    named: Collection[str] | None = None,
    scratch: Scratch | None = None,
    steps: Mapping[str, int] | None = None,
) -> Batch:
    """Return rows as a batch in which free axes are packed.

    Args:
        fields: The fields by name.
        rows: Those with a free axis as entries end to end, all others as rows; changed in place.
        known: Number of entries of each row, by free axis.
        named: Which of the added fields are wanted besides ``node_ptr``; None: all.
        scratch: Arrays to reuse; None: all are new.
        steps: How many rows a sample has, by free axis, if it has several.

    Returns:
        The fields, with numbers of entries counted from the first one of the batch, and for an
        axis ``node`` also ``node_ptr``, the first entry of each sample and the end, shape
        (samples + 1), and ``node_batch``, the sample of each entry; of samples of several rows also
        ``node_sizes``, the number of entries of each row, shape (samples, rows).
    """
    found = dict(rows)
    starts: dict[str, Index] = {}
    for axis, counts in known.items():
        ptr = np.zeros(len(counts) + 1, np.int64)
        counts.cumsum(out=ptr[1:])
        starts[axis] = ptr[:-1]
        if steps and axis in steps:
            found[axis + SIZES] = counts.reshape(-1, steps[axis])
            ptr = ptr[:: steps[axis]]
        found[axis + PTR] = ptr
        name, shape, kind = axis + BATCH, (int(ptr[-1]),), np.dtype(np.int64)
        if named is not None and name not in named:
            continue
        out = np.empty(shape, kind) if scratch is None else scratch.take(name, shape, kind)
        found[name] = _samples_of(ptr, out)
    for name, field in fields.items():
        if field.indexes:
            shift, values = starts[field.indexes], found[name].astype(np.int64, copy=False)
            if field.free_axis:
                shift = np.repeat(shift, known[field.free_axis])
            elif steps and field.indexes in steps:
                shift = shift.reshape(len(values), -1)
            found[name] = values + shift.reshape(*shift.shape, *(1,) * (values.ndim - shift.ndim))
    return found


def packed_fields(axes: Iterable[str], steps: Mapping[str, int] | None = None) -> dict[str, Field]:
    """Return the fields that packing adds to a batch for free axes: see `pack`."""
    names = {axis + suffix: () for axis in axes for suffix in (PTR, BATCH)}
    shapes = names | {axis + SIZES: (count,) for axis, count in (steps or {}).items()}
    return {n: Field(n, shape, "int64", role="additional") for n, shape in shapes.items()}
