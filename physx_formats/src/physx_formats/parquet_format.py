"""Parquet: one file with a column for each field; arrays are nested lists of fixed size.

Complex numbers are lists of two numbers. The metadata of each column hold unit, role, shape and
NumPy type.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import Field
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

COMPRESSIONS = ("none", "snappy", "gzip", "zstd", "lz4", "brotli")
_ROW_GROUP = 2 * BLOCK


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the rows of one mode."""
    (table,) = tables
    arrow = import_library("pyarrow", "Exporting to Parquet", "parquet")
    parquet = import_library("pyarrow.parquet", "Exporting to Parquet", "parquet")
    columns = [
        arrow.field(name, _type(arrow, field), nullable=False, metadata=_metadata(field))
        for name, field in table.fields.items()
    ]
    schema = arrow.schema(columns, metadata={"physx": encode_notes(tables)})
    with parquet.ParquetWriter(
        out, schema, compression=options.compression, use_dictionary=False
    ) as writer:
        for block in table.blocks(_ROW_GROUP):
            arrays = [_array(arrow, column.type, block[column.name]) for column in schema]
            writer.write_batch(arrow.RecordBatch.from_arrays(arrays, schema=schema))
    return 0


def _metadata(field: Field) -> dict[str, str]:
    shape = ",".join(str(length) for length in field.shape or ())
    dtype = np.dtype(field.dtype).name
    return {"unit": field.unit, "role": field.role, "shape": shape, "dtype": dtype}


def _shape(field: Field) -> tuple[int, ...]:
    pair = (2,) if np.dtype(field.dtype).kind == "c" else ()
    return (*(field.shape or ()), *pair)


def _type(arrow: Any, field: Field) -> Any:
    dtype = np.dtype(field.dtype)
    try:
        kind = arrow.from_numpy_dtype(np.empty(0, dtype).real.dtype)
    except (arrow.ArrowNotImplementedError, arrow.ArrowInvalid) as error:
        raise ExchangeError(
            f'Parquet has no equivalent of {dtype}, the type of the field "{field.name}".'
        ) from error
    if 0 in (field.shape or ()):
        raise ExchangeError(
            f'Parquet cannot hold arrays without elements, such as those of "{field.name}".'
        )
    for length in reversed(_shape(field)):
        kind = arrow.list_(kind, length)
    return kind


def _array(arrow: Any, kind: Any, values: Array) -> Any:
    """Return rows as an Arrow array; lists of lists share one flat array of numbers."""
    if np.iscomplexobj(values):
        values = np.stack([values.real, values.imag], axis=-1)
    array = arrow.array(values.reshape(-1))
    for axis in reversed(range(1, values.ndim)):
        array = arrow.FixedSizeListArray.from_arrays(array, values.shape[axis])
    return array.cast(kind)


FORMAT = Format(write=write, compressions=COMPRESSIONS)
