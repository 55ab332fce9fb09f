"""Tables: the rows of one mode in transfer to or from a file of another format."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from physx_core import checks
from physx_core.dataset import Episode, ModeView, find_episodes, rows_per_block
from physx_core.errors import ConfigError, MissingLibraryError
from physx_core.fields import NUMBERS, RESERVED, TEXT, Field, Role
from physx_core.parsing import parse_json
from physx_core.typing import Array, Batch
from physx_formats.errors import ExchangeError

FORMAT = "physx export"
VERSION = 1
BLOCK = 2**23
"""Approximate number of bytes of a block in memory."""

KINDS = NUMBERS + TEXT
"""Kinds of NumPy types that can be imported."""

Advance = Callable[[int], None]
"""Called with the number of bytes transferred."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of the formats.

    Attributes:
        compression: Name of the format's compression, or "none".
        observations: Fields that are the observations of an episode (minari and lerobot only);
            empty: all training fields without another role.
        actions: Fields that are its actions (likewise).
        rewards: Field that is its rewards (likewise); None: minari has zeros, lerobot none.
        fps: Frames per second of simulated time (lerobot, which requires it, and vtkhdf).
        task: Description of the task (lerobot only).
        features: Fields of a feature, by its name: "observation.state" (lerobot only). Those of
            several fields are one vector; pictures, uint8 of shape (height, width, 3), that are
            observations, such as "observation.images.top", become videos.
        points: Field with the positions of the mesh's points, of rows or of episodes, shape
            (points, 1 to 3) (vtkhdf only, and required there).
        cells: Field with the numbers of each cell's points, shape (cells, points of each)
            (vtkhdf only); None: each point is a cell.
        cell_type: Name of their type (vtkhdf only); None: by their number of points, of 4 a quad in
            the plane, else a tetra.
    """

    compression: str = "none"
    observations: Sequence[str] = ()
    actions: Sequence[str] = ()
    rewards: str | None = None
    fps: int | None = None
    task: str | None = None
    features: Mapping[str, Sequence[str]] = field(default_factory=dict)
    points: str | None = None
    cells: str | None = None
    cell_type: str | None = None

    def __post_init__(self) -> None:
        checks.store_declared("", self)


@dataclass(frozen=True)
class Table:
    """The rows of one mode to export.

    Attributes:
        mode: Name of the mode.
        fields: The fields by name, all with shapes.
        rows: Number of rows to export; rows that a writer adds meanwhile are left out.
        info: Where the data come from.
        view: Reads the rows, or holds those of the table of episodes.
        advance: Called with the number of bytes read.
    """

    mode: str
    fields: Mapping[str, Field]
    rows: int
    info: Mapping[str, Any]
    view: ModeView | Batch
    advance: Advance

    @property
    def row_nbytes(self) -> int:
        """Bytes of the values of one row."""
        return sum(field.nbytes for field in self.fields.values())

    @property
    def trajectories(self) -> list[Episode]:
        """The trajectories.

        Raises:
            ExchangeError: If it is the table of episodes.
            DatasetError: If they are unknown.
        """
        if not isinstance(self.view, ModeView):
            raise ExchangeError(f'The mode "{self.mode}" holds records, not trajectories.')
        return find_episodes(self.view.rows)

    def column(self, name: str, step: int | None = None) -> Iterator[tuple[int, Array]]:
        """Yield the rows of one field in blocks, each with the number of its first row.

        Args:
            name: Name of the field.
            step: Rows per block; None: as many as take about `BLOCK` bytes.
        """
        values = self.view[name]
        step = step or rows_per_block(self.fields[name].nbytes, BLOCK)
        for start in range(0, self.rows, step):
            block = values[start : min(start + step, self.rows)]
            self.advance(block.nbytes)
            yield start, block

    def blocks(self, nbytes: int) -> Iterator[Batch]:
        """Yield blocks of rows of all fields, about `nbytes` bytes each."""
        step = rows_per_block(self.row_nbytes, nbytes)
        columns = [self.column(name, step) for name in self.fields]
        for parts in zip(*columns, strict=True):
            yield {name: block for name, (_, block) in zip(self.fields, parts, strict=True)}


class Column(Protocol):
    """The rows of one field to import, read from the first to the last.

    Attributes:
        shape: (rows, *field shape).
        dtype: Type of the values.
        unit: Their unit according to the file.
        problem: Why the field cannot be imported; empty if it can.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    unit: str
    problem: str

    def read(self, start: int, count: int) -> Array:
        """Return the next `count` rows, which begin at `start`."""
        ...


class ArrayColumn:
    """A column whose rows are in memory; see `Column`.

    Args:
        values: Shape (rows, *field shape).
        unit: Their unit, if the file says so.
    """

    problem = ""

    def __init__(self, values: Array, unit: str = "") -> None:
        self._values, self.unit = values, unit
        self.shape, self.dtype = values.shape, values.dtype

    def read(self, start: int, count: int) -> Array:
        """Return the next `count` rows, which begin at `start`."""
        return self._values[start : start + count]


def is_picture(field: Field) -> bool:
    """Return whether a field has the colors of pictures, uint8 of shape (height, width, 3)."""
    shape = field.shape or ()
    return field.numpy_dtype == np.uint8 and len(shape) == 3 and shape[2] == 3 and 0 not in shape


def check_new(path: Path) -> None:
    """Check that a file or folder can be created under a name."""
    if path.exists() or not path.absolute().parent.is_dir():
        why = "exists already" if path.exists() else "would be in a folder that does not exist"
        raise ExchangeError(f"{path} {why}. Choose another path.")


def check_size(path: Path, nbytes: int, limit: int) -> None:
    """Check that a file does not hold more than `limit` bytes before any of it is read."""
    if nbytes > limit:
        raise ExchangeError(
            f"{path} claims that it holds {nbytes / 1e9:.3g} GB, far more than its own size. If "
            f"that is correct, import it with max_bytes={nbytes} (--max-bytes {nbytes})."
        )


def encode_notes(tables: Sequence[Table], limit: int | None = None) -> str:
    """Return what a file stores about modes in addition to their rows, as JSON.

    Args:
        tables: The modes.
        limit: Maximum number of bytes; if exceeded, only the most important notes are kept.
    """
    plain: dict[str, Any] = {"format": FORMAT, "format_version": VERSION}
    plain["modes"] = {t.mode: [of.to_dict() for of in t.fields.values()] for t in tables}
    text = json.dumps({**plain, "info": dict(tables[0].info) if tables else {}})
    if limit is None or len(text) <= limit:
        return text
    text = json.dumps(plain)
    return text if len(text) <= limit else "{}"


@dataclass(frozen=True)
class Notes:
    """Notes of a file about its rows; empty if physx did not write it.

    Attributes:
        modes: Mode to the fields by name, for their units, roles, axes and what they are like.
        info: Where the data come from.
    """

    modes: Mapping[str, Mapping[str, Field]] = field(default_factory=dict)
    info: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str | bytes) -> Notes:
        """Return what `encode_notes` wrote; empty notes for any other text."""
        try:
            plain = parse_json(text)
            if plain["format"] != FORMAT:
                return cls()
            modes = {
                mode: {of.name: of for of in map(Field.from_dict, fields)}
                for mode, fields in plain["modes"].items()
            }
            return cls(modes, dict(plain.get("info", {})))
        except (ValueError, KeyError, TypeError, AttributeError, ConfigError):
            return cls()  # only notes are lost

    def field(self, mode: str, name: str, column: Column) -> Field:
        """Return the field of a column, with what is noted of it."""
        known = self.modes.get(mode, {}).get(name)
        is_no_input = name in RESERVED or column.dtype.kind == TEXT
        role: Role = "additional" if is_no_input else "training"
        shape = column.shape[1:]
        if known is None:
            return Field(name, shape, column.dtype, column.unit, role)
        axes = known.axes if len(known.axes) == len(shape) else ()
        return Field(name, shape, column.dtype, known.unit, known.role, axes, known.like)


def import_library(name: str, purpose: str, extra: str) -> Any:
    """Import a library that only one format needs.

    Args:
        name: Name of the module.
        purpose: Feature that needs it, for the error message.
        extra: The extra of physx-formats that installs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise MissingLibraryError(
            purpose, name.partition(".")[0], extra, "physx-formats"
        ) from error
