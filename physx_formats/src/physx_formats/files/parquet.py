"""Parquet: one file with a column for each field; arrays are nested lists of fixed size.

Complex numbers are lists of two numbers. The metadata of each column hold unit, role, shape and
NumPy type.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import TEXT, Field
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.files.sequential_rows import SequentialRows
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
_TEXT = re.compile(rb"\|S(\d{1,6})")


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
    dtype = field.numpy_dtype.str if field.is_text else field.numpy_dtype.name
    return {"unit": field.unit, "role": field.role, "shape": shape, "dtype": dtype}


def _shape(field: Field) -> tuple[int, ...]:
    pair = (2,) if np.dtype(field.dtype).kind == "c" else ()
    return (*(field.shape or ()), *pair)


def _type(arrow: Any, field: Field) -> Any:
    dtype = np.dtype(field.dtype)
    try:
        real = np.empty(0, dtype).real.dtype
        kind = arrow.string() if field.is_text else arrow.from_numpy_dtype(real)
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
    flat = values.reshape(-1)
    array = arrow.array(np.char.decode(flat, "utf-8") if values.dtype.kind == "S" else flat)
    for axis in reversed(range(1, values.ndim)):
        array = arrow.FixedSizeListArray.from_arrays(array, values.shape[axis])
    return array.cast(kind)


class _Column(SequentialRows):
    """A column of a file."""

    def __init__(self, path: Path, file: Any, field: Any) -> None:
        kind, shape = field.type, []
        while hasattr(kind, "list_size"):
            shape.append(kind.list_size)
            kind = kind.value_type
        known, dtype = field.metadata or {}, np.dtype(np.uint8)
        self._path, self._file, self._name = path, file, field.name
        try:
            dtype = np.dtype(kind.to_pandas_dtype())
        except NotImplementedError:
            self.problem = f'"{field.name}" of {path} holds {kind}.'
        if str(kind) in ("string", "large_string"):
            noted = _TEXT.fullmatch(known.get(b"dtype", b""))
            dtype = np.dtype(f"S{max(1, int(noted[1]) if noted else 0, self._longest())}")
        elif "list" in str(kind):
            self.problem = f'"{field.name}" of {path} holds lists of different lengths.'
        elif dtype.kind not in "biuf":
            self.problem = self.problem or f'"{field.name}" of {path} holds {kind}.'
        self._is_complex = known.get(b"dtype", b"").startswith(b"complex") and shape[-1:] == [2]
        if self._is_complex:
            shape, dtype = shape[:-1], np.result_type(dtype, np.complex64)
        self.unit = known.get(b"unit", b"").decode(errors="replace")
        super().__init__([file], field.name, dtype, shape)

    def _longest(self) -> int:
        """Return the largest number of bytes of a text."""
        batches = self._file.iter_batches(columns=[self._name])
        texts = (self._flat(batch.column(0)).to_pylist() for batch in batches)
        return max((len(text.encode()) for some in texts for text in some), default=0)

    def _flat(self, array: Any) -> Any:
        """Return the single values of a batch of the column."""
        while True:
            if array.null_count:
                raise ExchangeError(f'"{self._name}" of {self._path} has rows without a value.')
            if not hasattr(array.type, "list_size"):
                return array
            array = array.flatten()

    def _values(self, array: Any) -> Array:
        """Return a batch of the column as rows."""
        flat = self._flat(array)
        if self.dtype.kind == TEXT:
            values = np.array([text.encode() for text in flat.to_pylist()], self.dtype)
        else:
            values = flat.to_numpy(zero_copy_only=False)
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
    loses=("records",),
    compressions=COMPRESSIONS,
    recognizes=lambda path, begin: begin.startswith(b"PAR1"),
    open=open_columns,
    text=True,
)
