"""NumPy's ``.npz``: a zip archive with one array per field; nothing in it is ever unpickled.

The archive's comment holds units, roles and modes; `numpy.load` ignores it.
"""

from __future__ import annotations

import contextlib
import io
import math
import shlex
import sys
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.format import Format
from physx_formats.table import (
    KINDS,
    Column,
    ExportOptions,
    Notes,
    Table,
    check_size,
    encode_notes,
)

COMPRESSIONS = {"none": zipfile.ZIP_STORED, "deflate": zipfile.ZIP_DEFLATED}
_COMMENT = 2**16 - 1
_MOST_LISTED = 2**22
"""Maximum number of bytes of an archive's list of contents."""
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError)


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the fields as ``<field>``, or as ``<mode>/<field>`` if there are several modes."""
    with zipfile.ZipFile(out, "w", COMPRESSIONS[options.compression]) as archive:
        for table in tables:
            prefix = f"{table.mode}/" if len(tables) > 1 else ""
            for name in table.fields:
                with archive.open(f"{prefix}{name}.npy", "w", force_zip64=True) as file:
                    _write_array(table, name, file)
        archive.comment = encode_notes(tables, _COMMENT).encode()
    return 0


def _write_array(table: Table, name: str, file: IO[bytes]) -> None:
    field = table.fields[name]
    header = {
        "descr": npy.dtype_to_descr(np.dtype(field.dtype)),
        "fortran_order": False,
        "shape": (table.rows, *(field.shape or ())),
    }
    npy.write_array_header_1_0(file, header)
    for _, block in table.column(name):
        file.write(block.tobytes())


class NpzColumn:
    """An array of an archive, read sequentially; see `Column`."""

    unit = ""
    problem = ""

    def __init__(self, path: Path, name: str, file: IO[bytes], size: int) -> None:
        """Read the array's header.

        Args:
            path: The archive, for messages.
            name: Name of the array.
            file: Its bytes.
            size: Number of bytes according to the archive.
        """
        self._place, self._file = f'The array "{name}" of {path}', file
        try:
            version = npy.read_magic(file)
            read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
            self.shape, fortran, self.dtype = read(file)
        except (ValueError, KeyError, *_DAMAGE) as error:
            raise ExchangeError(f"{self._place} has no readable header.") from error
        self._whole: Array | None = None
        if self.dtype.kind not in KINDS or not self.shape:
            return  # it cannot be imported; the error is raised if it is requested
        self._row = math.prod(self.shape[1:]) * self.dtype.itemsize
        if min(self.shape) < 0 or size - file.tell() != self.shape[0] * self._row:
            raise ExchangeError(f"{self._place} is not as long as its header says.")
        if fortran:  # its rows are not contiguous
            flat = np.frombuffer(self._take(self.shape[0]), self.dtype)
            self._whole = flat.reshape(self.shape, order="F")

    def read(self, start: int, count: int) -> Array:
        """Return the next rows."""
        if self._whole is not None:
            return self._whole[start : start + count]
        shape = (count, *self.shape[1:])
        return np.frombuffer(self._take(count), self.dtype).reshape(shape)

    def _take(self, count: int) -> bytes:
        try:
            content = self._file.read(count * self._row)
        except _DAMAGE as error:
            raise ExchangeError(f"{self._place} is damaged: {error}.") from error
        if len(content) != count * self._row:
            raise ExchangeError(f"{self._place} is truncated.")
        return content


class _ArchiveFile(io.FileIO):
    """The file of an archive; reads of more than `longest` bytes at once are rejected."""

    longest = _MOST_LISTED

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes."""
        if size is not None and size > self.longest:
            raise zipfile.BadZipFile(f"its list of contents has {size} bytes")
        return super().read(size) or b""


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[dict[str, Column], Notes]]:
    """Open an archive; yield its arrays by name and the notes in its comment.

    Args:
        path: The archive.
        limit: Maximum number of bytes it may unpack to.
    """
    columns: dict[str, Column] = {}
    with contextlib.ExitStack() as files:
        try:
            source = files.enter_context(_ArchiveFile(path))
            archive = files.enter_context(zipfile.ZipFile(source))
            source.longest = sys.maxsize
            _refuse_torch(path, archive)
            check_size(path, sum(item.file_size for item in archive.infolist()), limit)
            damaged = archive.testzip()  # before any of it is stored
            if damaged is not None:
                raise zipfile.BadZipFile(f"{damaged} does not match its checksum")
            for item in archive.infolist():
                if item.filename.endswith(".npy"):
                    name = item.filename.removesuffix(".npy")
                    file = files.enter_context(archive.open(item))
                    columns[name] = NpzColumn(path, name, file, item.file_size)
            notes = Notes.parse(archive.comment)
        except _DAMAGE as error:
            raise ExchangeError(f"{path} is not a valid npz archive: {error}.") from error
        yield columns, notes


def _refuse_torch(path: Path, archive: zipfile.ZipFile) -> None:
    if any(name.endswith("/data.pkl") for name in archive.namelist()):
        out = shlex.quote(str(path.with_suffix(".safetensors")))
        raise ExchangeError(
            f"{path} is a file of PyTorch, whose objects are pickled. Convert it, if it holds a "
            "table of tensors, and import that file:\n"
            'python -c "import sys, torch; from safetensors.torch import save_file; '
            f'save_file(torch.load(sys.argv[1], weights_only=True), sys.argv[2])" '
            f"{shlex.quote(str(path))} {out}"
        )


FORMAT = Format(
    write=write,
    compressions=COMPRESSIONS,
    several=True,
    text=True,
    recognizes=lambda path, begin: begin.startswith(b"PK"),
    open=open_columns,
)
