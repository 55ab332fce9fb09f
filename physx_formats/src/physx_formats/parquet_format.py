"""Parquet: one file with a column for each field; arrays are nested lists of fixed size.

Complex numbers are lists of two numbers. The metadata of each column hold unit, role, shape and
NumPy type.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import Field
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns, Format
from physx_formats.table import (
    BLOCK,
    ExportOptions,
    Notes,
    Table,
    check_size,
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


class _Column:
    """A column of a file, read sequentially; see `Column`."""

    unit = ""

    def __init__(self, path: Path, file: Any, field: Any) -> None:
        kind, shape = field.type, []
        while hasattr(kind, "list_size"):
            shape.append(kind.list_size)
            kind = kind.value_type
        self._file, self._name = file, field.name
        self._batches: Iterator[Any] | None = None
        self.shape, self.problem = (file.metadata.num_rows, *shape), ""
        known = field.metadata or {}
        self.dtype = np.dtype(np.uint8)
        try:
            self.dtype = np.dtype(kind.to_pandas_dtype())
        except NotImplementedError:
            self.problem = f'"{field.name}" of {path} holds {kind}.'
        if "list" in str(kind):
            self.problem = f'"{field.name}" of {path} holds lists of different lengths.'
        elif self.dtype.kind not in "biuf":
            self.problem = self.problem or f'"{field.name}" of {path} holds {kind}.'
        self._is_complex = known.get(b"dtype", b"").startswith(b"complex") and shape[-1:] == [2]
        if self._is_complex:
            self.shape = self.shape[:-1]
            self.dtype = np.result_type(self.dtype, np.complex64)
        self.unit = known.get(b"unit", b"").decode(errors="replace")
        self._path, self._left = path, np.empty((0, *self.shape[1:]), self.dtype)

    def read(self, start: int, count: int) -> Array:
        """Return the next rows."""
        if self._batches is None:
            self._batches = self._file.iter_batches(columns=[self._name])
        parts = [self._left]
        while sum(map(len, parts)) < count:
            parts.append(self._values(next(self._batches).column(0)))
        rows = np.concatenate(parts)
        found, self._left = rows[:count], rows[count:]
        return found

    def _values(self, array: Any) -> Array:
        """Return a batch of the column as rows."""
        flat = array
        while True:
            if flat.null_count:
                raise ExchangeError(f'"{self._name}" of {self._path} has rows without a value.')
            if not hasattr(flat.type, "list_size"):
                break
            flat = flat.flatten()
        values: Array = flat.to_numpy(zero_copy_only=False)
        if self._is_complex:
            values = np.ascontiguousarray(values).view(self.dtype)
        return values.reshape(-1, *self.shape[1:])


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[Columns, Notes]]:
    """Open a file; yield its columns by name and the notes in its metadata."""
    arrow = import_library("pyarrow", "Importing Parquet", "parquet")
    parquet = import_library("pyarrow.parquet", "Importing Parquet", "parquet")
    try:
        file = parquet.ParquetFile(path)
    except (arrow.ArrowInvalid, OSError) as error:
        raise ExchangeError(f"{path} is not a valid Parquet file: {error}.") from error
    with file:
        schema = file.schema_arrow
        columns: Columns = {field.name: _Column(path, file, field) for field in schema}
        sizes = (math.prod(each.shape) * each.dtype.itemsize for each in columns.values())
        check_size(path, sum(sizes), limit)
        try:
            yield columns, Notes.parse((schema.metadata or {}).get(b"physx", b""))
        except (arrow.ArrowInvalid, OSError) as error:
            raise ExchangeError(f"{path} is damaged: {error}.") from error


FORMAT = Format(
    write=write,
    compressions=COMPRESSIONS,
    recognizes=lambda path, begin: begin.startswith(b"PAR1"),
    open=open_columns,
)
