"""Meshes: the rows of windows of free axes, each packed as a batch of single rows is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from physx_core.errors import ConfigError
from physx_core.fields import BATCH, PTR, SIZES, Field
from physx_core.packing import ranges
from physx_core.typing import Array, Batch, Index


class Rows(NamedTuple):
    """The rows of a batch of windows whose meshes stay the same.

    Attributes:
        values: The rows of each field, in the order of its window.
        added: What packing adds to a batch of any of the rows.
    """

    values: dict[str, list[Array]]
    added: Batch


def split_rows(batch: Batch, read: Mapping[str, Field], single: Mapping[str, Field]) -> Rows:
    """Return the rows of windows.

    Args:
        batch: A batch of windows of several rows; those of fields that have or number entries of
            free axes have the same offsets.
        read: Its fields by name.
        single: The fields of a batch of single rows.

    Raises:
        ConfigError: If a mesh changes within a window.
    """
    sizes: dict[str, Index] = {}
    for name, field in single.items():
        if field.free_axis:
            counts = batch[read[name].free_axis + SIZES]
            if (counts != sizes.setdefault(field.free_axis, counts[:, 0])[:, None]).any():
                raise _changed(name, f'the size of its axis "{field.free_axis}"')
    ptr = {axis: np.append(0, np.cumsum(counts)) for axis, counts in sizes.items()}
    values = {
        name: _rows_of(batch[name], batch.get(read[name].free_axis + SIZES), field, sizes, ptr)
        for name, field in single.items()
    }
    for name, field in single.items():
        if field.indexes and any(not np.array_equal(row, values[name][0]) for row in values[name]):
            raise _changed(name, "which entries it numbers")
    added = {axis + PTR: starts for axis, starts in ptr.items()}
    added |= {axis + BATCH: np.repeat(np.arange(len(n)), n) for axis, n in sizes.items()}
    return Rows(values, added)


def _rows_of(
    values: Array,
    counts: Index | None,
    field: Field,
    sizes: Mapping[str, Index],
    ptr: Mapping[str, Index],
) -> list[Array]:
    """Return the rows of a field; numbers of entries are counted as in a batch of single rows."""
    if field.free_axis:
        assert counts is not None
        own, rows = sizes[field.free_axis], counts.shape[1]
        starts = rows * ptr[field.free_axis][:-1]
        found = [values[ranges(starts + row * own, own)] for row in range(rows)]
    else:
        rows = values.shape[1]
        found = [values[:, row] for row in range(rows)]
    if not field.indexes:
        return found
    before = (rows - 1) * ptr[field.indexes][:-1]
    for row, numbers in enumerate(found):
        shift = before + row * sizes[field.indexes]
        if field.free_axis:
            shift = np.repeat(shift, sizes[field.free_axis])
        found[row] = numbers - shift.reshape(-1, *(1,) * (numbers.ndim - 1))
    return found


def _changed(name: str, what: str) -> ConfigError:
    return ConfigError(
        "Training.unroll feeds predictions back into the mesh that they belong to, but within a "
        f'window of "{name}" {what} changes. Train on single steps, or choose episodes whose mesh '
        "stays the same (View.episodes)."
    )


def renumber(
    tensors: Mapping[str, Any], fields: Mapping[str, Field], added: Batch, step: int
) -> dict[str, Any]:
    """Return a step's fields as they are in a batch of all steps, end to end.

    Args:
        tensors: The fields by name.
        fields: Those of single rows.
        added: See `Rows`.
        step: How many such steps are before it.
    """
    found = dict(tensors)
    for name, values in tensors.items():
        if name in fields:
            axis = fields[name].indexes
            found[name] = values + step * int(added[axis + PTR][-1]) if axis else values
        elif name.endswith(BATCH):
            found[name] = values + step * (len(added[name.removesuffix(BATCH) + PTR]) - 1)
        elif name in added:
            found[name] = values[1:] + step * int(added[name][-1])
    return found
