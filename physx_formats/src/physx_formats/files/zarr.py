"""Zarr: a folder with ``<mode>/<field>``, chunked along the rows, with units as attributes.

``xarray.open_zarr(folder, group=mode)`` opens a mode: with units, the time and the episode of each
row as coordinates, and those of the axes if the dataset's ``info`` has ``coordinates`` by axis.
Metadata are consolidated, so that opening reads a single file.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset import rows_per_block
from physx_core.fields import RESERVED, Field
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.format import Format
from physx_formats.table import (
    BLOCK,
    ExportOptions,
    Table,
    encode_notes,
    import_library,
)

COMPRESSIONS = ("none", "zstd", "gzip", "blosc")
_CODECS = {"zstd": "ZstdCodec", "gzip": "GzipCodec", "blosc": "BloscCodec"}


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the modes as groups of arrays."""
    zarr = import_library("zarr", "Exporting to Zarr", "zarr")
    codecs = import_library("zarr.codecs", "Exporting to Zarr", "zarr")
    codec = _CODECS.get(options.compression)
    used = [getattr(codecs, codec)()] if codec else None
    root = zarr.create_group(str(out), attributes={"physx": json.loads(encode_notes(tables))})
    for table in tables:
        group = root.create_group(table.mode)
        for name in table.fields:
            _write_field(group, table, name, used)
        for axis, values in _coordinates(table).items():
            stored = group.create_array(
                axis, shape=values.shape, dtype=values.dtype, dimension_names=[axis]
            )
            stored[:] = values
    with warnings.catch_warnings():  # that libraries other than zarr and xarray may not support it
        warnings.simplefilter("ignore")
        zarr.consolidate_metadata(str(out))
    return 0


def _write_field(group: Any, table: Table, name: str, codecs: list[Any] | None) -> None:
    field = table.fields[name]
    step, shape = rows_per_block(field.nbytes, BLOCK), field.shape or ()
    try:
        stored = group.create_array(
            name,
            shape=(table.rows, *shape),
            dtype=np.dtype(field.dtype),
            chunks=(min(step, table.rows), *(max(1, length) for length in shape)),
            compressors=codecs,
            dimension_names=["sample", *_dimensions(table, name)],
            attributes=_attributes(table, field),
        )
    except (ValueError, TypeError) as error:
        raise ExchangeError(
            f'Zarr cannot hold the field "{name}" of type {np.dtype(field.dtype)}: {error}.'
        ) from error
    for start, block in table.column(name, step):
        if field.nbytes:
            stored[start : start + len(block)] = block


def _attributes(table: Table, field: Field) -> dict[str, str]:
    """Return a field's attributes: its unit as physx and as CF name it, and its coordinates."""
    found = {"unit": field.unit, "role": field.role}
    if field.unit:
        found["units"] = field.unit
    along = [n for n in ("time", *RESERVED) if n in table.fields and table.fields[n].shape == ()]
    if along and field.name not in along:
        found["coordinates"] = " ".join(along)
    return found


def _coordinates(table: Table) -> dict[str, Array]:
    """Return where the points of named axes are, as far as the dataset's ``info`` says so."""
    known = table.info.get("coordinates", {})
    found = {}
    for axis, values in known.items() if isinstance(known, dict) else ():
        array = np.asarray(values)
        fits = array.ndim == 1 and array.dtype.kind in "iuf" and axis not in table.fields
        if fits and _length(table, axis) == len(array):
            found[axis] = array
    return found


def _dimensions(table: Table, name: str) -> list[str]:
    """Return the names of a field's axes; in other fields, an axis of that name is as long."""
    field = table.fields[name]
    names = list(field.axes) or [str(axis) for axis in range(len(field.shape or ()))]
    return [
        axis if field.axes and _length(table, axis) is not None else f"{name}_{axis}"
        for axis in names
    ]


def _length(table: Table, axis: str) -> int | None:
    """Return the length of an axis; None if it is not the same in all fields."""
    found = {
        (of.shape or ())[of.axes.index(axis)] for of in table.fields.values() if axis in of.axes
    }
    return found.pop() if len(found) == 1 and axis != "sample" else None


FORMAT = Format(write=write, loses=("way back",), compressions=COMPRESSIONS, several=True)
