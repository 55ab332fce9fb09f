"""Table: sets of parameters from a file."""

from __future__ import annotations

import csv
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from physx_core.components.parameter import Parameter
from physx_core.components.sampler import Sampler, checked
from physx_core.errors import ConfigError, listed, nearest
from physx_core.typing import Array

_UNREADABLE = (OSError, ValueError, KeyError, EOFError, MemoryError, zipfile.BadZipFile, csv.Error)


class Table(Sampler):
    """The rows of a table, one set each, in order, repeatedly.

    A CSV file has a header line and a column for each parameter; one with several elements has the
    columns ``name_0``, ``name_1`` ... in C order. An npz file has an array for each parameter, of
    shape (rows, *parameter's shape). Other columns are ignored.

    Attributes:
        count: Number of rows.
    """

    def __init__(self, file: str | Path) -> None:
        """Store the file's path.

        Args:
            file: A CSV or npz file.
        """
        self._file = Path(file)
        self.count = 0

    def begin(self, parameters: Sequence[Parameter], seed: Sequence[int]) -> None:
        """Read the file: see `Sampler.begin`."""
        super().begin(parameters, seed)
        read = self._read_npz if self._file.suffix == ".npz" else self._read_csv
        try:
            self._columns = read()
        except _UNREADABLE as error:
            raise ConfigError(f"The table {self._file} cannot be read: {error}.") from error
        counts = {len(column) for column in self._columns.values()}
        if len(counts) != 1 or not max(counts):
            numbers = listed(map(str, sorted(counts)))
            raise ConfigError(f"The columns of the table {self._file} have {numbers} rows.")
        (self.count,) = counts
        for row in range(self.count):
            self._check(row)

    def ask(self, number: int) -> dict[str, Any]:
        """Return the values of a set."""
        row = number % self.count
        return {name: column[row].copy() for name, column in self._columns.items()}

    def _check(self, row: int) -> None:
        try:
            values = checked(self.parameters, self.ask(row))
        except ConfigError as error:
            raise ConfigError(f"Row {row + 1} of the table {self._file}: {error}") from error
        for parameter in self.parameters:
            if not parameter.contains(values[parameter.name]):
                raise ConfigError(
                    f"Row {row + 1} of the table {self._file}: {parameter.name} = "
                    f"{values[parameter.name]} is not within its bounds."
                )

    def _read_npz(self) -> dict[str, Array]:
        with np.load(self._file, allow_pickle=False) as stored:
            self._check_columns([p.name for p in self.parameters], stored.files)
            return {parameter.name: stored[parameter.name] for parameter in self.parameters}

    def _read_csv(self) -> dict[str, Array]:
        with self._file.open(newline="", encoding="utf-8") as file:
            lines = [line for line in csv.reader(file) if line]
        names, *rows = [[text.strip() for text in line] for line in lines] or [[]]
        wanted = {parameter.name: parameter.columns for parameter in self.parameters}
        self._check_columns([name for group in wanted.values() for name in group], names)
        found = {}
        for parameter in self.parameters:
            places = [names.index(name) for name in wanted[parameter.name]]
            convert: Any = int if parameter.field.numpy_dtype.kind == "i" else float
            cells = [[_cell(row, place, convert) for place in places] for row in rows]
            found[parameter.name] = np.array(cells).reshape(len(rows), *parameter.shape)
        return found

    def _check_columns(self, wanted: Sequence[str], given: Sequence[str]) -> None:
        for name in wanted:
            if name not in given:
                raise ConfigError(
                    f'The table {self._file} has no column "{name}".{nearest(name, given)} It has: '
                    f"{listed(given)}."
                )


def _cell(row: Sequence[str], place: int, convert: Any) -> Any:
    if place >= len(row):
        raise ValueError(f"a line has {len(row)} columns: {', '.join(row)}")
    return convert(row[place])
