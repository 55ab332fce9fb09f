"""One ordinary HDF5 file: ``/<mode>/<field>``, with units and roles as attributes."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.dataset import hdf5_type, rows_per_block
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.files.layouts import read_layout
from physx_formats.format import Format
from physx_formats.table import Column, ExportOptions, Notes, Table, encode_notes

COMPRESSIONS = {"none": None, "gzip": "gzip", "lzf": "lzf"}
_CHUNK = 2**20
_ATTRIBUTE = 60000
"""Maximum number of bytes in an attribute."""
_MOST_ITEMS = 10_000
_LARGEST_CHUNK = 2**28
_UNREADABLE = (OSError, RuntimeError, KeyError, TypeError, ValueError)
"""Errors that HDF5 raises for a damaged file or types that NumPy does not have."""


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the modes as groups of datasets.

    Without compression each dataset is contiguous, so that it can be mapped into memory.
    """
    import h5py

    compression = COMPRESSIONS[options.compression]

    with _Sink(out, "w+") as sink:
        with h5py.File(sink, "w") as file:
            file.attrs["physx"] = encode_notes(tables, _ATTRIBUTE)
            for table in tables:
                group = file.create_group(table.mode)
                for name in table.fields:
                    _write_field(group, table, name, compression, sink)
        sink.check()
    return 0


class _Sink(io.FileIO):
    """A file that hides write errors from HDF5; `check` raises the first one.

    HDF5 terminates the process when a write fails.
    """

    _error: OSError | None = None

    def write(self, content: Any) -> int:
        """Write the whole content, or nothing after an earlier error."""
        view = memoryview(content).cast("B")
        count = len(view)
        try:
            while view and self._error is None:
                view = view[super().write(view) :]
        except OSError as error:
            self._error = error
        return count

    def truncate(self, size: int | None = None, /) -> int:
        """Set the length of the file, unless there was an error."""
        try:
            return super().truncate(size) if self._error is None else 0
        except OSError as error:
            self._error = error
            return 0

    def check(self) -> None:
        """Raise the first write error, if any."""
        if self._error is not None:
            raise self._error


def _write_field(group: Any, table: Table, name: str, compression: str | None, sink: _Sink) -> None:
    field = table.fields[name]
    shape, options = (table.rows, *(field.shape or ())), {}
    if compression and 0 not in shape:
        rows = min(table.rows, rows_per_block(field.nbytes, _CHUNK))
        options = {"compression": compression, "shuffle": True, "chunks": (rows, *shape[1:])}
    kind = hdf5_type(field)
    stored = group.create_dataset(name, shape, kind, **options)
    stored.attrs["unit"], stored.attrs["role"] = field.unit, field.role
    for axis, label in enumerate(("sample", *field.axes) if field.axes else ()):
        stored.dims[axis].label = label
    for start, block in table.column(name):
        stored[start : start + len(block)] = block.view(kind)
        sink.check()


class Hdf5Column:
    """A dataset of an HDF5 file; see `Column`."""

    problem = ""

    def __init__(self, place: str, dataset: Any) -> None:
        self.shape: tuple[int, ...] = dataset.shape or ()
        self.dtype: np.dtype[Any] = dataset.dtype
        unit = dataset.attrs.get("unit", dataset.attrs.get("units", ""))
        self.unit = unit if isinstance(unit, str) else ""
        self._place, self._dataset = place, dataset

    def read(self, start: int, count: int) -> Array:
        """Return rows."""
        try:
            rows: Array = self._dataset[start : start + count]
        except (OSError, RuntimeError) as error:
            raise ExchangeError(f"{self._place} cannot be read: {error}.") from error
        return rows


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[dict[str, Column], Notes]]:
    """Open a file; yield its datasets by path, or as its layout has them, and notes.

    The sizes that the datasets claim are checked when they are chosen.
    """
    import h5py

    with contextlib.ExitStack() as files:
        try:
            file = files.enter_context(h5py.File(path, "r"))
            columns = dict(_columns(path, file, "", set(), itertools.count()))
            notes = Notes.parse(file.attrs.get("physx", "{}"))
            if not notes.modes and (found := read_layout(path, file)) is not None:
                columns, notes = found
        except ExchangeError:
            raise
        except _UNREADABLE as error:
            raise ExchangeError(f"{path} cannot be read as HDF5: {error}.") from error
        yield columns, notes


def _columns(
    path: Path, group: Any, prefix: str, seen: set[Any], items: Iterator[int]
) -> Iterator[tuple[str, Column]]:
    """Yield the datasets below a group; links are rejected, not followed."""
    import h5py

    for name in group:
        place = f'"{prefix}{name}" of {path}'
        if next(items) == _MOST_ITEMS:  # groups that contain each other may be few
            raise ExchangeError(f"{path} has more than {_MOST_ITEMS} datasets and groups.")
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ExchangeError(f"{place} is a link, and links are not followed.")
        item = group[name]
        if isinstance(item, h5py.Dataset):
            _check_storage(place, item)
            yield f"{prefix}{name}", Hdf5Column(place, item)
        elif isinstance(item, h5py.Group):
            address = h5py.h5o.get_info(item.id).addr
            if address in seen:
                raise ExchangeError(f"{place} is a group that contains itself.")
            yield from _columns(path, item, f"{prefix}{name}/", {*seen, address}, items)


def _check_storage(place: str, dataset: Any) -> None:
    """Check that the values are in the file itself, in pieces that fit into memory."""
    if dataset.is_virtual:
        raise ExchangeError(
            f"{place} is virtual: its values are in other files, which are not followed. Import "
            "those files; for a physx dataset, pass its folder to Dataset.merge."
        )
    if dataset.external:
        raise ExchangeError(f"{place} stores its values in other files, which are not followed.")
    if dataset.chunks is not None:
        nbytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
        if nbytes > _LARGEST_CHUNK:
            raise ExchangeError(
                f"{place} is stored in chunks of {nbytes} bytes, more than {_LARGEST_CHUNK}: "
                "rewrite it with smaller chunks (h5repack)."
            )


FORMAT = Format(
    write=write,
    compressions=COMPRESSIONS,
    several=True,
    text=True,
    recognizes=lambda path, begin: begin == b"\x89HDF\r\n\x1a\n",
    open=open_columns,
)
