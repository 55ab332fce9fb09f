"""CSV: the rows of one mode as text, one column per number.

A column is named after its field, the place of the number in arrays, and the unit:
``position[0][2] [m]``. Text holds no types: columns of integers become int64, or uint64 if they
do not fit, of ``true`` and ``false`` bool, others of numbers float64, and the rest text, as wide as
the longest. The decimal numbers are exact.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.fields import TEXT, Field
from physx_core.typing import Array
from physx_formats.errors import ExchangeError
from physx_formats.format import Columns, Format
from physx_formats.table import BLOCK, ExportOptions, Notes, Table, check_size, import_library

_MOST_COLUMNS = 10_000
_KINDS = ("bool", "int64", "double", "string", "null")
"""Types of columns that are fields; others, such as dates, are text."""
_LARGE = 2.0**63
"""Number from which integers are no int64, and would lose digits as float64."""
_NAME = re.compile(r"(?P<name>.*?)(?P<place>(\[\d+\])*)(\s+\[(?P<unit>[^\[\]]*)\])?")


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the rows of one mode."""
    (table,) = tables
    arrow = import_library("pyarrow", "Exporting to CSV", "csv")
    csv = import_library("pyarrow.csv", "Exporting to CSV", "csv")
    names = [name for field in table.fields.values() for name in _names(field)]
    if len(names) > _MOST_COLUMNS:
        raise ExchangeError(
            f"A CSV file would have {len(names):,} columns. Choose another format, or fewer fields "
            "(physx edit --keep)."
        )
    with out.open("wb") as file:
        form = csv.WriteOptions(include_header=True)
        for block in table.blocks(BLOCK):
            columns = [column for values in block.values() for column in _columns(values)]
            csv.write_csv(arrow.table(columns, names=names), file, form)
            form = csv.WriteOptions(include_header=False)
    return 0


def _names(field: Field) -> Iterator[str]:
    if field.numpy_dtype.kind == "c":
        raise ExchangeError(
            f'CSV has no equivalent of {field.numpy_dtype}, the type of the field "{field.name}".'
        )
    shape = field.shape or ()
    units = [each.strip() for each in field.unit.split(",")]
    for place in itertools.product(*map(range, shape)):
        own = units[place[0]] if len(shape) == 1 and len(units) == shape[0] else field.unit
        index = "".join(f"[{each}]" for each in place)
        yield f"{field.name}{index}{f' [{own}]' if own else ''}"


def _columns(values: Array) -> Iterator[Array]:
    if values.dtype.kind == TEXT:
        values = np.char.decode(values, "utf-8")
    if values.dtype.kind == "f":
        values = values.astype(np.float64)  # the decimal number is then the exact one
    yield from np.ascontiguousarray(values.reshape(len(values), -1).T)


class _Column:
    """Columns that are one field; see `Column`."""

    def __init__(
        self, path: Path, name: str, table: Any, parts: dict[tuple[int, ...], Any]
    ) -> None:
        """Arrange columns.

        Args:
            path: The file, for messages.
            name: Name of the field.
            table: The file's columns.
            parts: Number and unit of each column, by its place in the field.
        """
        size = () if () in parts else tuple(max(each) + 1 for each in zip(*parts, strict=True))
        self.shape = (table.num_rows, *size)
        arrays = [table.column(parts[place][0]) for place in sorted(parts)]
        kinds = [np.dtype(each.type.to_pandas_dtype()) for each in arrays]
        self.problem, self._is_text = "", all(str(each.type) == "string" for each in arrays)
        if self._is_text:
            arrays = [each.fill_null("") for each in arrays]
            texts = (text for each in arrays for text in each.to_pylist())
            longest = max((len(text.encode()) for text in texts), default=0)
            kinds = [np.dtype(f"S{max(1, longest)}")]
        self.dtype = np.result_type(*kinds)
        units = [parts[place][1] for place in sorted(parts)]
        self.unit = units[0] if len(set(units)) == 1 else ", ".join(units)
        missing = next((each for each in arrays if each.null_count), None)
        if len(parts) != np.prod(size, dtype=int):
            self.problem = f'The columns of "{name}" in {path} leave out places of {size}.'
        elif missing is not None:
            row = next(k for k, each in enumerate(missing) if not each.is_valid)
            self.problem = f'"{name}" of {path} has no number in row {row}.'
        elif not self._is_text and any(kind.kind not in "biuf" for kind in kinds):
            self.problem = (
                f'Only some columns of "{name}" of {path} hold numbers. Choose what to '
                "import with fields (--fields on the command line)."
            )
        self._arrays = arrays

    def read(self, start: int, count: int) -> Array:
        """Return the next rows."""
        parts = [each.slice(start, count) for each in self._arrays]
        if self._is_text:
            parts = [np.array([t.encode() for t in each.to_pylist()], self.dtype) for each in parts]
        else:
            parts = [each.to_numpy() for each in parts]
        return np.stack(parts, axis=-1).astype(self.dtype).reshape(-1, *self.shape[1:])


def _read(csv: Any, path: Path) -> Any:
    """Return the columns of a file, of the types that text says."""

    def read(types: Mapping[str, str]) -> Any:
        options = csv.ConvertOptions(
            column_types=types,
            null_values=["", "NA", "null"],
            strings_can_be_null=True,
            quoted_strings_can_be_null=False,
        )
        return csv.read_csv(path, convert_options=options)

    table, types = read({}), dict[str, str]()
    for name, column in zip(table.column_names, table.columns, strict=True):
        if str(column.type) not in _KINDS:
            types[name] = "string"
        elif str(column.type) == "double" and (np.abs(column.to_numpy()) >= _LARGE).any():
            with contextlib.suppress(ValueError):  # it holds no integers
                read({**types, name: "uint64"})
                types[name] = "uint64"
    return read(types) if types else table


@contextlib.contextmanager
def open_columns(path: Path, limit: int) -> Iterator[tuple[Columns, Notes]]:
    """Open a file; yield its columns by field."""
    import_library("pyarrow", "Importing CSV", "csv")
    csv = import_library("pyarrow.csv", "Importing CSV", "csv")
    check_size(path, path.stat().st_size, limit)

    try:
        table = _read(csv, path)
    except (ValueError, OSError) as error:
        raise ExchangeError(f"{path} is not a valid CSV file: {error}.") from error
    fields: dict[str, dict[tuple[int, ...], tuple[int, str]]] = {}
    for number, title in enumerate(table.column_names):
        found = _NAME.fullmatch(title.strip())
        assert found is not None  # any text matches
        place = tuple(int(each) for each in re.findall(r"\d+", found["place"]))
        parts = fields.setdefault(found["name"], {})
        if place in parts or any(len(each) != len(place) for each in parts):
            raise ExchangeError(f'{path} has several columns for the same place of "{title}".')
        parts[place] = number, found["unit"] or ""
    yield {name: _Column(path, name, table, parts) for name, parts in fields.items()}, Notes()


FORMAT = Format(
    write=write,
    loses=("types", "notes", "records"),
    recognizes=lambda path, begin: path.suffix.lower() == ".csv",
    open=open_columns,
    text=True,
)
"""CSV files have nothing that identifies them but their name."""
