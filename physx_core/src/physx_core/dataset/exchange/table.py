"""Tables: the rows of one mode on their way into or out of a file of another format."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from physx_core.dataset.read.views import ModeView
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.fields import RESERVED, Field, Role
from physx_core.typing import Array, Batch

FORMAT = "physx export"
VERSION = 1
BLOCK = 2**23
"""Bytes of the blocks that are in memory at a time."""

Advance = Callable[[int], None]
"""Is told how many bytes went through."""


@dataclass(frozen=True)
class Table:
    """The rows of one mode that leave a dataset.

    Attributes:
        mode: Name of the mode.
        fields: The fields by name, all with shapes.
        rows: How many rows leave; those that a writer adds meanwhile stay.
        info: Where the data come from.
        view: Gives the rows.
        advance: Is told how many bytes were read.
    """

    mode: str
    fields: Mapping[str, Field]
    rows: int
    info: Mapping[str, Any]
    view: ModeView
    advance: Advance

    @property
    def nbytes(self) -> int:
        """Bytes of all values."""
        return self.rows * sum(field.nbytes for field in self.fields.values())

    def column(self, name: str, step: int) -> Iterator[tuple[int, Array]]:
        """Yield blocks of `step` rows of one field, each with the number of its first row."""
        values = self.view[name]
        for start in range(0, self.rows, step):
            block = values[start : min(start + step, self.rows)]
            self.advance(block.nbytes)
            yield start, block

    def blocks(self, nbytes: int = BLOCK) -> Iterator[Batch]:
        """Yield blocks of rows of all fields, of about `nbytes` bytes."""
        step = rows_of(sum(field.nbytes for field in self.fields.values()), nbytes)
        columns = [self.column(name, step) for name in self.fields]
        for parts in zip(*columns, strict=True):
            yield {name: block for name, (_, block) in zip(self.fields, parts, strict=True)}


def rows_of(row_nbytes: int, nbytes: int = BLOCK) -> int:
    """Return how many rows of a size make about `nbytes` bytes, at least one."""
    return max(1, nbytes // max(1, row_nbytes))


class Column(Protocol):
    """The rows of one field that enter a dataset, read from the first to the last.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the values.
        unit: Unit that the file says of them.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    unit: str

    def read(self, start: int, count: int) -> Array:
        """Return the next rows, those from `start` on.

        Raises:
            ExchangeError: The file is damaged.
        """
        ...


def describe(tables: Sequence[Table], limit: int | None = None) -> str:
    """Return what a file keeps of modes besides their rows, as JSON.

    Args:
        tables: The modes.
        limit: Most bytes that the file can keep; then only the most important stays.
    """
    plain: dict[str, Any] = {"format": FORMAT, "format_version": VERSION}
    plain["modes"] = {t.mode: [field.to_dict() for field in t.fields.values()] for t in tables}
    text = json.dumps({**plain, "info": dict(tables[0].info) if tables else {}})
    if limit is None or len(text) <= limit:
        return text
    text = json.dumps(plain)
    return text if len(text) <= limit else "{}"


@dataclass(frozen=True)
class Notes:
    """What a file says of its rows; a file that physx did not write says nothing.

    Attributes:
        modes: Mode to the fields by name, for their units and roles.
        info: Where the data come from.
    """

    modes: Mapping[str, Mapping[str, Field]]
    info: Mapping[str, Any]

    @classmethod
    def read(cls, text: str | bytes) -> Notes:
        """Return what `describe` wrote; nothing from any other text."""
        try:
            plain = json.loads(text)
            if plain["format"] != FORMAT:
                return cls({}, {})
            fields = {
                mode: {field.name: field for field in map(Field.from_dict, listed)}
                for mode, listed in plain["modes"].items()
            }
            return cls(fields, dict(plain.get("info", {})))
        except (ValueError, KeyError, TypeError, AttributeError, ConfigError):
            return cls({}, {})  # no more than a note is lost

    def field(self, mode: str, name: str, column: Column) -> Field:
        """Return the field of a column, with unit and role if they are noted."""
        known = self.modes.get(mode, {}).get(name)
        role: Role = "additional" if name in RESERVED else "training"
        unit, role = (known.unit, known.role) if known is not None else (column.unit, role)
        return Field(name, column.shape[1:], column.dtype, unit, role)


def library(name: str, purpose: str, extra: str) -> Any:
    """Import a library that only this needs.

    Args:
        name: Name of the module.
        purpose: What needs it, for the error's text.
        extra: Extra of physx-core that brings it.

    Raises:
        MissingLibraryError: It is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingLibraryError(purpose, name.partition(".")[0], extra) from error
