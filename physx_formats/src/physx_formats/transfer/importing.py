"""Imports rows from files of other formats: each recognizes its own."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from physx_core.config import MODES
from physx_core.dataset import EPISODES, TABLE_FIELDS, Dataset, holds_dataset
from physx_core.errors import listed
from physx_core.fields import Field
from physx_core.typing import Batch
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns, all_formats, find_format
from physx_formats.table import KINDS, Advance, Column, Notes, check_size
from physx_formats.transfer.episodes import EpisodeCopier, copy_stream, split_records

_SESSION = "import"
_ALWAYS = 2**28
_RATIO = 100
"""Maximum ratio of a file's contents to its size, for contents of more than `_ALWAYS` bytes."""
_LEAST_ROW = 8


def import_file(
    path: str | Path,
    directory: str | Path,
    *,
    form: str | None = None,
    mode: str | None = None,
    fields: Sequence[str] = (),
    max_bytes: int | None = None,
    advance: Advance = lambda nbytes: None,
) -> dict[str, int]:
    """Store the arrays of a file as fields of a dataset, block by block.

    Arrays of equal length become the fields of one mode; groups become part of the names
    (``obs/state`` is the field ``obs_state``). Only groups that are named after modes, and those in
    files written by physx, become modes themselves. Independent episodes that physx has exported
    with their records are stored as such, after all campaigns that the dataset has.

    Args:
        path: A NumPy archive (npz), an HDF5, Parquet, safetensors or MCAP file or a DeepPhysX
            database, of any name; a file ``*.csv``; the folder of a LeRobot dataset, a DeepPhysX
            dataset or session, or of a recording of ROS 2; or what the formats of other plugins
            recognize.
        directory: The dataset's folder. Rows are appended if the dataset exists.
        form: Name of its format; None: the one that recognizes it.
        mode: Mode for the rows, regardless of the mode in the file; for a file with several modes,
            the one to import. None: the modes that the file names, or else ``training``.
        fields: Names of the arrays to import, as in the file; empty: all of them.
        max_bytes: Maximum number of bytes of the arrays, as a small file can unpack to any size;
            None: 100 times the size of the file, but at least 0.27 GB.
        advance: Called with the number of bytes stored.

    Returns:
        Number of rows added to each mode.

    Raises:
        ComponentNotFoundError: If there is no format of that name.
        ReferenceFormError: If several plugins have one, and `form` does not say which.
        ExchangeError: If the file is missing or damaged, no format recognizes it or several do, its
            arrays differ in length, or it holds
            more than `max_bytes`.
        SampleError: If a value is NaN or infinite.
        DatasetError: If the dataset has other fields or cannot be written.
    """
    path, directory = Path(path), Path(directory)
    limit = max(_ALWAYS, _RATIO * _size_of(path)) if max_bytes is None else max_bytes
    with _open(path, limit, form) as (columns, notes):
        chosen = _choose(path, columns, fields)
        check_size(path, sum(map(_size_of_column, chosen.values())), limit)
        modes = _arrange(path, chosen, notes, mode)
        tables = {name: _make_fields(path, name, found, notes) for name, found in modes.items()}
        with _open_target(directory) as dataset:
            if not dataset.modes:
                dataset.update_info(**{**notes.info, "imported_from": path.name})
            records = _take_records(path, modes, tables)
            done = {
                name: copy_stream(dataset, name, tables[name], found, advance)
                for name, found in modes.items()
                if name not in records
            }
            for name, entries in records.items():
                own = (tables[name], modes[name], tables[EPISODES])
                done[name] = EpisodeCopier(dataset, name, *own, advance).copy(entries)
            return done


def _take_records(
    path: Path, modes: dict[str, Columns], tables: Mapping[str, Mapping[str, Field]]
) -> dict[str, Batch]:
    """Take the table of episodes out of the modes, if there is one; return the records by mode."""
    fields = tables.get(EPISODES, {})
    own = {field.name: field.numpy_dtype for field in TABLE_FIELDS}
    if any(n not in fields or fields[n].numpy_dtype != kind for n, kind in own.items()):
        return {}
    table = {name: column.read(0, column.shape[0]) for name, column in modes.pop(EPISODES).items()}
    lengths = {name: next(iter(found.values())).shape[0] for name, found in modes.items()}
    return split_records(path, table, lengths)


def _size_of(path: Path) -> int:
    """Return the size in bytes of a file, or of the files in a folder."""
    try:
        files = [path, *(path.rglob("*") if path.is_dir() else ())]
        return sum(file.lstat().st_size for file in files)
    except OSError:  # the reader reports it
        return 0


def _size_of_column(column: Column) -> int:
    rows, *shape = column.shape
    return rows * max(_LEAST_ROW, math.prod(shape) * column.dtype.itemsize)


def _open(
    path: Path, limit: int, form: str | None
) -> AbstractContextManager[tuple[Columns, Notes]]:
    """Open a file with the given format, or the one that recognizes it."""
    begin = b""
    if not path.is_dir():
        if not path.is_file():
            raise ExchangeError(f"There is no file {path}.")
        try:
            with path.open("rb") as file:
                begin = file.read(8)
        except OSError as error:
            raise ExchangeError(f"{path} cannot be read: {error.strerror}.") from error
    formats = all_formats() if form is None else {form: find_format(form)}
    readers = {name: each.open for name, each in formats.items() if each.open is not None}
    found = [name for name in readers if form or formats[name].recognizes(path, begin)]
    if len(found) == 1:
        return readers[found[0]](path, limit)
    if found:
        raise ExchangeError(
            f"{path} may be of several formats: {listed(found)}. Choose one of them with form "
            "(--from on the command line)."
        )
    if form:
        raise ExchangeError(f"Nothing can be imported from {form}.")
    what = "folder" if path.is_dir() else "file"
    raise ExchangeError(
        f"The {what} {path} is of no known format: {listed(readers)}. To add rows of another physx "
        "dataset, use Dataset.merge."
    )


@contextlib.contextmanager
def _open_target(directory: Path) -> Iterator[Dataset]:
    """Open the dataset for writing, or create it; a created one is removed if the import fails."""
    if holds_dataset(directory) or holds_dataset(directory / "dataset"):
        with Dataset.open(directory, writable=True) as dataset:
            yield dataset
        return
    was_there = directory.is_dir()
    if was_there and any(directory.iterdir()):
        raise ExchangeError(f"{directory} is not empty and not a dataset. Choose a new folder.")
    try:
        with Dataset.create(directory, session=_SESSION) as dataset:
            yield dataset
    except BaseException:
        for file in directory.iterdir():
            file.unlink()
        if not was_there:
            directory.rmdir()
        raise


def _choose(path: Path, columns: Columns, names: Sequence[str]) -> Columns:
    missing = [name for name in names if name not in columns]
    if missing or not columns:
        wanted = f'no array "{missing[0]}"' if missing else "no arrays"
        raise ExchangeError(f"{path} has {wanted}. It has: {listed(columns)}.")
    chosen = {name: columns[name] for name in names} if names else columns
    for name, column in chosen.items():
        if column.problem:
            raise ExchangeError(column.problem)
        if column.dtype.kind not in KINDS or not column.dtype.itemsize or not column.shape:
            what = "no rows" if not column.shape else str(column.dtype)
            raise ExchangeError(
                f'"{name}" of {path} holds {what}; a field has rows of plain numbers, or of text '
                "with a fixed number of bytes. Choose what to import with fields (--fields on the "
                "command line)."
            )
    return chosen


def _arrange(path: Path, columns: Columns, notes: Notes, mode: str | None) -> dict[str, Columns]:
    """Return the columns by mode and field name."""
    parts = {name: name.split("/") for name in columns}
    known = notes.modes.keys() or set(MODES)
    has_modes = all(len(words) > 1 and words[0] in known for words in parts.values())
    only = next(iter(notes.modes)) if len(notes.modes) == 1 else "training"
    modes: dict[str, Columns] = {}
    for name, words in parts.items():
        of = words.pop(0) if has_modes else (mode or only)
        field = re.sub(r"\W", "_", "_".join(words))
        field = field if field.isidentifier() else f"_{field}"
        found = modes.setdefault(of, {})
        if field in found:
            raise ExchangeError(f'Two arrays of {path} would become the field "{field}".')
        found[field] = columns[name]
    if mode is None:
        return modes
    if mode not in modes and len(modes) > 1:
        raise ExchangeError(f'{path} has no mode "{mode}". Modes: {listed(modes)}.')
    return {mode: modes[mode] if mode in modes else next(iter(modes.values()))}


def _make_fields(path: Path, mode: str, columns: Columns, notes: Notes) -> dict[str, Field]:
    lengths = {name: column.shape[0] for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} {count}" for name, count in lengths.items())
        raise ExchangeError(
            f"The arrays of {path} have different numbers of rows: {counts}. Choose those that "
            "belong together with fields (--fields on the command line)."
        )
    noted = mode if mode in notes.modes else next(iter(notes.modes), mode)
    fields = {name: notes.field(noted, name, column) for name, column in columns.items()}
    return {n: f if f.like in fields else replace(f, like="") for n, f in fields.items()}
