"""Safetensors: one file with an array per field, as networks' parameters are stored.

Units, roles and modes are in the file's metadata.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import Field
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns, Format
from physx_formats.table import ExportOptions, Notes, Table, check_size, encode_notes

_NAMES = {
    np.dtype(kind): name
    for kind, name in (
        *((f"<f{size}", f"F{8 * size}") for size in (2, 4, 8)),
        *((f"<i{size}", f"I{8 * size}") for size in (1, 2, 4, 8)),
        *((f"<u{size}", f"U{8 * size}") for size in (1, 2, 4, 8)),
        ("<c8", "C64"),
        ("?", "BOOL"),
    )
}
_LONGEST = 100_000_000
"""Greatest length of a header in bytes, by the format's definition."""
_ALIGNMENT = 8


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the fields as ``<field>``, or as ``<mode>/<field>`` if there are several modes.

    The library writes arrays that are in memory only; here each block is written as it is read.
    """
    header: dict[str, Any] = {"__metadata__": {"physx": encode_notes(tables)}}
    end = 0
    for table in tables:
        prefix = f"{table.mode}/" if len(tables) > 1 else ""
        for name, field in table.fields.items():
            begin, end = end, end + table.rows * field.nbytes
            header[f"{prefix}{name}"] = {
                "dtype": _name_of(field),
                "shape": [table.rows, *(field.shape or ())],
                "data_offsets": [begin, end],
            }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    with out.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for table in tables:
            for name in table.fields:
                for _, block in table.column(name):
                    file.write(block.tobytes())
    return 0


def _name_of(field: Field) -> str:
    if field.numpy_dtype not in _NAMES:
        raise ExchangeError(
            f"safetensors has no equivalent of {field.numpy_dtype}, the type of the field "
            f'"{field.name}". Export the other fields: physx edit --drop {field.name}.'
        )
    return _NAMES[field.numpy_dtype]


class _Column:
    """An array of a file; see `Column`."""

    unit = ""

    def __init__(self, path: Path, name: str, entry: Any) -> None:
        self._entry = entry
        self.shape = tuple(entry.get_shape())
        known = {each: dtype for dtype, each in _NAMES.items()}
        kind = str(entry.get_dtype())
        self.dtype = known.get(kind, np.dtype(np.uint8))
        self.problem = "" if kind in known else f'"{name}" of {path} holds numbers of type {kind}.'

    def read(self, start: int, count: int) -> Array:
        """Return the next rows."""
        found: Array = self._entry[start : start + count]
        return found


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[Columns, Notes]]:
    """Open a file; yield its arrays by name and the notes in it."""
    from safetensors import SafetensorError, safe_open

    try:
        file: Any = safe_open(path, framework="np")
    except SafetensorError as error:
        raise ExchangeError(f"{path} is not a valid safetensors file: {error}.") from error
    with file:
        columns: Columns = {}
        for name in file.keys():  # noqa: SIM118  (the file is no mapping)
            columns[name] = _Column(path, name, file.get_slice(name))
        sizes = (math.prod(each.shape) * each.dtype.itemsize for each in columns.values())
        check_size(path, sum(sizes), limit)
        yield columns, Notes.parse((file.metadata() or {}).get("physx", ""))


def _recognizes(path: Path, begin: bytes) -> bool:
    if len(begin) < 8 or not 2 <= int.from_bytes(begin, "little") <= _LONGEST:
        return False
    with path.open("rb") as file:
        return file.read(9)[8:] == b"{"


FORMAT = Format(write=write, several=True, recognizes=_recognizes, open=open_columns)
