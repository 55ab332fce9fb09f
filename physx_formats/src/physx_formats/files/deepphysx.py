"""DeepPhysX datasets: folders of SQLite databases or, in older versions, of NumPy files.

Either each database ``<session>_<mode>_<index>.db`` is a partition, with the tables ``Training``
and ``Additional`` (v22.12), or ``dataset.db`` holds everything, with the tables ``train``, ``test``
and ``run`` (v25). Numbers are plain columns; arrays are pickles, which `load_array` reads. Before
v22.12, partitions were files ``<session>_<mode>_<IN, OUT or ADD_name>_<index>.npy``.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.config import MODES
from physx_core.errors import listed
from physx_core.fields import NUMBERS, RESERVED, Field
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.files.array_pickle import ArrayPickleError, load_array
from physx_formats.files.npz import NpzColumn
from physx_formats.format import Format
from physx_formats.table import Column, Notes

_DATABASE = re.compile(rf"(.+)_({'|'.join(MODES)})_(\d+)\.db")
_NUMPY_FILE = re.compile(rf"(.+?)_({'|'.join(MODES)})_(.+)_(\d+)\.npy")
_WHOLE = "dataset.db"
_TABLES = {
    "training": ("", "training"),
    "additional": ("", "additional"),
    "train": ("training", "training"),
    "test": ("validation", "training"),
    "run": ("prediction", "training"),
}
"""Name of a table to its mode ("" for that of the partition) and the role of its fields."""
_NUMPY_FIELDS = {"IN": "input", "OUT": "ground_truth"}
_NUMPY_ADDITIONAL = "ADD_"
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
_LARGEST_VALUE = 2**30
_HIDDEN = ("id", "_dt_")
_AT_A_TIME = 64
_CHOOSE = "choose other fields (--fields on the command line)."


@dataclass(frozen=True)
class _Part:
    """The rows of one field in one partition.

    Attributes:
        place: Where they are, for messages.
        rows: Their number.
        read: Returns the next rows, given the number of the first and the count.
    """

    place: str
    rows: int
    read: Callable[[int, int], Iterable[Any]]


class PartsColumn:
    """A field of all partitions of a mode, in sequence; see `Column`."""

    unit = ""
    problem = ""

    def __init__(self, parts: Sequence[_Part]) -> None:
        """Take type and shape from the first row."""
        self._parts = parts
        values = self._rows()
        try:
            first = next(values)
        except ExchangeError as error:  # raised only if the field is requested
            first, self.problem = np.zeros((), object), str(error)
        self.shape: tuple[int, ...] = (sum(part.rows for part in parts), *first.shape)
        self.dtype: np.dtype[Any] = first.dtype
        self._values = itertools.chain([first], values)

    def read(self, start: int, count: int) -> Array:
        """Return the next rows."""
        block = np.empty((count, *self.shape[1:]), self.dtype)
        for number, value in enumerate(itertools.islice(self._values, count)):
            if value.shape != self.shape[1:] or not np.can_cast(value.dtype, self.dtype):
                raise ExchangeError(
                    f"Row {start + number} has the shape {value.shape} and the type {value.dtype}, "
                    f"unlike the first row of {self._parts[0].place} with {self.shape[1:]} and "
                    f"{self.dtype}. All rows of a field have the same shape and type: {_CHOOSE}"
                )
            block[number] = value
        return block

    def _rows(self) -> Iterator[Array]:
        for part in self._parts:
            number = 0
            for start in range(0, part.rows, _AT_A_TIME):
                for value in part.read(start, min(_AT_A_TIME, part.rows - start)):
                    yield _array_of(f"Row {number} of {part.place}", value)
                    number += 1
            if number != part.rows:
                raise ExchangeError(f"{part.place} has fewer rows than counted.")


def _array_of(where: str, value: Any) -> Array:
    if isinstance(value, bytes):
        try:
            return load_array(value)
        except ArrayPickleError as error:
            raise ExchangeError(f"{where} is not an array of numbers: {error}.") from error
    if value is None:
        raise ExchangeError(
            f"{where} has no value, which DeepPhysX stores silently. A field needs a value in "
            f"every row: {_CHOOSE}"
        )
    return np.asarray(value)


# Finding ----------------------------------------------------------------------------------------


def find_folder(directory: Path) -> Path | None:
    """Return the folder of a DeepPhysX dataset, given that or its session's; None if not found."""
    for folder in (directory, directory / "dataset"):
        if folder.is_dir() and any(_is_partition(path) for path in folder.iterdir()):
            return folder
    return None


def _is_partition(path: Path) -> bool:
    form = _NUMPY_FILE if path.suffix == ".npy" else _DATABASE
    return path.name == _WHOLE or form.fullmatch(path.name) is not None


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[dict[str, Column], Notes]]:
    """Open a database, or a folder of databases or old files; yield fields and notes on roles.

    The fields' names are ``<mode>/<field>``. Their contents are no larger than the files.
    """
    paths = [path]
    if path.is_dir():
        folder = find_folder(path) or path
        paths = sorted(filter(_is_partition, folder.iterdir()), key=_order)
    parts: dict[tuple[str, str, str], list[_Part]] = {}
    with contextlib.ExitStack() as opened:
        for file in paths:
            if file != path and (file.is_symlink() or not file.is_file()):
                raise ExchangeError(f"{file} is not a regular file; links are not followed.")
            find = _numpy_parts if file.suffix == ".npy" else _database_parts
            for key, part in find(file, opened):
                parts.setdefault(key, []).append(part)
        yield _columns(parts)


def _order(path: Path) -> tuple[str, int]:
    start, _, number = path.stem.rpartition("_")
    return (start, int(number)) if number.isdecimal() else (path.stem, 0)


def _columns(
    parts: dict[tuple[str, str, str], list[_Part]],
) -> tuple[dict[str, Column], Notes]:
    columns: dict[str, Column] = {}
    modes: dict[str, dict[str, Field]] = {}
    for (mode, role, name), found in parts.items():
        if not any(part.rows for part in found):
            continue
        column = PartsColumn(found)
        name = name if f"{mode}/{name}" not in columns else f"{role}_{name}"
        columns[f"{mode}/{name}"] = column
        noted = modes.setdefault(mode, {})
        is_plain = column.dtype.kind in NUMBERS and name.isidentifier() and name not in RESERVED
        if role == "additional" and is_plain:
            noted[name] = Field(name, column.shape[1:], column.dtype, role="additional")
    return columns, Notes(modes)


# Databases --------------------------------------------------------------------------------------


def _database_parts(
    path: Path, opened: contextlib.ExitStack
) -> Iterator[tuple[tuple[str, str, str], _Part]]:
    match = _DATABASE.fullmatch(path.name)
    with _reading(path):
        database = opened.enter_context(contextlib.closing(_connect(path)))
        tables = _tables(path, database)
    if not tables:
        raise ExchangeError(f"{path} has none of DeepPhysX's tables: {listed(_TABLES)}.")
    known: set[tuple[str, str]] = set()
    for table, (rows, names) in tables.items():
        own_mode, role = _TABLES[table]
        mode = own_mode or (match[2] if match else MODES[0])
        for name in names:
            if name in RESERVED and (mode, name) in known:  # both tables have env_id
                continue
            known.add((mode, name))
            yield (mode, role, name), _database_part(path, database, table, name, rows)


def _database_part(
    path: Path, database: sqlite3.Connection, table: str, name: str, rows: int
) -> _Part:
    quoted = name.replace('"', '""')
    query = f'SELECT "{quoted}" FROM "{table}" ORDER BY rowid'
    cursor = database.cursor()

    def read(start: int, count: int) -> Iterator[Any]:
        """Yield the next rows one by one, as each may be as large as the file."""
        with _reading(path):
            if start == 0:
                cursor.execute(query)
            for (value,) in itertools.islice(cursor, count):
                yield value

    return _Part(f'"{name}" in the table {table} of {path}', rows, read)


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database for reading only; its schema may be hostile."""
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA cell_size_check = ON")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_VALUE)
    return database


def _tables(path: Path, database: sqlite3.Connection) -> dict[str, tuple[int, list[str]]]:
    """Return the number of rows and the column names of each of DeepPhysX's tables."""
    found = {
        name.lower(): str(text)
        for name, text in database.execute("SELECT name, sql FROM sqlite_master WHERE type='table'")
    }
    tables, nbytes = {}, path.stat().st_size
    for name in _TABLES:
        if name not in found:
            continue
        is_plain = found[name].upper().startswith("CREATE TABLE")
        columns = database.execute(f'PRAGMA table_xinfo("{name}")').fetchall() if is_plain else []
        if not is_plain or any(hidden for *_, hidden in columns):
            raise ExchangeError(f"The table {name} of {path} is computed, not stored.")
        # Each row takes bytes, but in a damaged file it may be reachable on several paths.
        counted = f'SELECT count(*) FROM (SELECT 1 FROM "{name}" LIMIT {nbytes})'
        (rows,) = database.execute(counted).fetchone()
        if rows == nbytes:
            raise ExchangeError(f"{path} is damaged: its table {name} has more rows than bytes.")
        tables[name] = rows, [column[1] for column in columns if column[1] not in _HIDDEN]
    allowed, denied = sqlite3.SQLITE_OK, sqlite3.SQLITE_DENY
    database.set_authorizer(lambda action, *_: allowed if action in _ALLOWED else denied)
    return tables


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
        raise ExchangeError(f"{path} cannot be read as an SQLite database: {error}.") from error


# NumPy files of older versions ------------------------------------------------------------------


def _numpy_parts(
    path: Path, opened: contextlib.ExitStack
) -> Iterator[tuple[tuple[str, str, str], _Part]]:
    match = _NUMPY_FILE.fullmatch(path.name)
    if match is None:
        return
    mode, given = match[2], match[3]
    name = _NUMPY_FIELDS.get(given, given.removeprefix(_NUMPY_ADDITIONAL))
    role = "additional" if given.startswith(_NUMPY_ADDITIONAL) else "training"
    file = opened.enter_context(path.open("rb"))
    column = NpzColumn(path, path.stem, file, path.stat().st_size)
    if column.dtype.kind not in NUMBERS or not column.shape:
        raise ExchangeError(f"{path} holds {column.dtype}, not rows of plain numbers.")
    yield (mode, role, name), _Part(str(path), column.shape[0], column.read)


def _recognizes(path: Path, begin: bytes) -> bool:
    if path.is_dir():
        return find_folder(path) is not None
    return begin.startswith(b"SQLite f")


FORMAT = Format(recognizes=_recognizes, open=open_columns)
