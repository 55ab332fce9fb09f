"""Writes the virtual index ``<session>.h5``: all sealed rows in one file, for other tools.

It holds ``/<mode>/<field>`` as virtual datasets that refer to the partitions in the same folder. If
several sessions wrote the dataset, there is one index named after each, and each shows all rows.
With a free axis ``node``, a field has the entries of all rows, those of row i from ``node_ptr[i]``
up to ``node_ptr[i + 1]``. The rows of a mode with episodes are in order of campaign and number; if
they lie in too many pieces for a virtual dataset, the mode has no fields, and its attribute
``pieces`` says in how many. physx itself never reads them.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store.manifest import Mode, Partition, Partitions
from physx_core.dataset.store.partition.format import hdf5_type
from physx_core.dataset.store.partition.spans import FlatIndex
from physx_core.fields import PTR, Field
from physx_core.typing import Index

FORMAT = "physx index"

_MOST_PIECES = 4096

Piece = tuple[Partition, slice, slice]
"""A partition, some of its rows, and their places in the mode."""


def write_index(reader: Reader, session: str, *, wait: bool = False) -> None:
    """Write the index of all sealed rows.

    Args:
        reader: Knows the rows.
        session: Session that writes it; it gets an index even if it has no rows yet.
        wait: Whether to wait for the disk.
    """
    import h5py

    image, manifest = io.BytesIO(), reader.manifest
    with h5py.File(image, "w") as file:
        file.attrs["format"], file.attrs["format_version"] = FORMAT, 1
        for name in manifest.modes:
            _add_mode(file.create_group(name), reader, name)
    for name in {session, *manifest.sessions}:
        files.replace(reader.directory / f"{name}.h5", image.getvalue(), wait=wait)


def _add_mode(group: Any, reader: Reader, name: str) -> None:
    mode, order = reader.mode(name), reader.order(name)
    if order is not None and len(order.places.rows) > _MOST_PIECES:
        group.attrs["pieces"] = len(order.places.rows)
        return
    pieces = list(_stored_pieces(mode) if order is None else _pieces(mode, order))
    entries = {axis: _entries(reader, mode, name, axis, pieces) for axis in mode.axes}
    for axis, (_, ptr) in entries.items():
        group.create_dataset(axis + PTR, data=ptr)
    for field in mode.fields.values():
        if field.shape is not None:
            _add(group, field, entries[field.free_axis][0] if field.free_axis else pieces)


def _entries(
    reader: Reader, mode: Mode, name: str, axis: str, pieces: list[Piece]
) -> tuple[list[Piece], Index]:
    """Return the pieces of rows as those of their entries, and the first entry of each row."""
    spans = {p.key: span for p, span in zip(mode.partitions, mode.spans, strict=True)}
    bounds, found, counts = reader.bounds(name, axis), [], [np.zeros(1, np.intp)]
    place = 0
    for partition, part, _ in pieces:
        start = spans[partition.key].start
        known = bounds[start + part.start : start + part.stop + 1]
        first, count = int(known[0] - bounds[start]), int(known[-1] - known[0])
        if count:
            found.append((partition, slice(first, first + count), slice(place, place + count)))
        counts.append(np.diff(known))
        place += count
    return found, np.cumsum(np.concatenate(counts))


def _stored_pieces(mode: Mode) -> Iterator[Piece]:
    """Yield all rows of the sealed partitions, as they are stored."""
    sealed = Partitions(partition for partition in mode.partitions if partition.sealed)
    for partition, span in sealed.between(0, sealed.rows):
        yield partition, slice(0, span.rows), span.among(0, span.rows, 0)


def _pieces(mode: Mode, order: Order) -> Iterator[Piece]:
    """Yield the rows of the sealed partitions in order."""
    done, spans = 0, mode.spans
    index = FlatIndex(spans)
    for first, rows in order.pieces(0, order.rows):
        found, number, piece = 0, index.find(first)[0], (first, first + rows)
        while number < len(spans) and spans[number].start < first + rows:
            partition, (begin, count) = mode.partitions[number], spans[number].inside(*piece)
            if count and not partition.sealed:
                break
            if count:
                where = spans[number].among(begin, count, first - done)
                yield partition, slice(begin, begin + count), where
            found, number = found + count, number + 1
        done += found


def _add(group: Any, field: Field, pieces: list[Piece]) -> None:
    import h5py

    rows = sum(part.stop - part.start for _, part, _ in pieces)
    shape, dtype = (rows, *field.entry_shape), hdf5_type(field)
    if not rows or not field.nbytes:
        entry = group.create_dataset(field.name, shape, dtype)
    else:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        if dtype.kind == "f":
            layout.set_fill_value(np.array(np.nan, dtype))  # of rows of a lost partition
        space = h5py.h5s.create_simple(shape)
        for partition, part, where in pieces:
            source = h5py.h5s.create_simple((partition.rows_of(field), *shape[1:]))
            _select(source, part)
            _select(space, where)
            file = partition.file_name(field.name).encode()
            layout.set_virtual(space, file, b"data", source)
        space.select_all()
        kind = h5py.h5t.py_create(dtype, logical=True)
        h5py.h5d.create(group.id, field.name.encode(), kind, space, layout)
        entry = group[field.name]
    entry.attrs["unit"], entry.attrs["role"] = field.unit, field.role


def _select(space: Any, rows: slice) -> None:
    """Select some rows of a space; h5py's own layouts take eight times as long for each piece."""
    others = space.shape[1:]
    start = rows.start, *(0 for _ in others)
    space.select_hyperslab(start, (rows.stop - rows.start, *others))
