"""VTKHDF: one file with a mesh, its fields, and a time step for each row, for ParaView and VTK.

The file is HDF5, in version 2.2 of the format: one unstructured grid, whose points, cells and data
lie end to end, with the offsets of each step. A mesh that episodes store once is stored once for
each. On free axes, meshes have any size.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from physx_core.config import MODES
from physx_core.dataset import EPISODES
from physx_core.errors import ConfigError, listed, nearest
from physx_core.fields import Field
from physx_core.typing import Array, Index
from physx_formats.errors import ExchangeError
from physx_formats.format import Format
from physx_formats.table import BLOCK, ExportOptions, Table

VERSION = (2, 2)
CELLS = {
    "vertex": (1, 1), "line": (3, 2), "triangle": (5, 3), "quad": (9, 4), "tetra": (10, 4),
    "pyramid": (14, 5), "wedge": (13, 6), "hexahedron": (12, 8),
}  # fmt: skip
"""Number of the cell type in VTK, and its number of points."""
_GUESSED = {1: "vertex", 2: "line", 3: "triangle", 5: "pyramid", 6: "wedge", 8: "hexahedron"}
_SPACE = 3
_CHUNK = 2**18
_FREE_ROWS = 16
"""Rows of any size that are read at once."""


@dataclass(frozen=True)
class _Mesh:
    """A field of points or cells.

    Attributes:
        field: The field.
        table: Where its values are.
        place: Which of them each row has, shape (rows,); it never falls.
    """

    field: Field
    table: Table
    place: Index

    def values(self, *, by_row: bool) -> Iterator[Array]:
        """Yield each value, or that of each row."""
        if not by_row:
            yield from _each(self.field, self.table)
            return
        last = -1
        found = _each(self.field, self.table)
        for place in self.place:
            while last < place:
                value, last = next(found), last + 1
            yield value


def write(tables: Sequence[Table], out: Path, options: ExportOptions) -> int:
    """Write the rows of one mode as time steps."""
    found = {table.mode: table for table in tables}
    episodes = found.pop(EPISODES, None)
    if len(found) != 1:
        raise ConfigError(
            "vtkhdf holds one mode. Choose one with modes (--mode on the command line): "
            f"{listed(found)}."
        )
    (table,) = found.values()
    points = _find(table, episodes, "points", options.points)
    cells = None if options.cells is None else _find(table, episodes, "cells", options.cells)
    kind, by_cell = _cell_type(options, points.field, None if cells is None else cells.field)
    with h5py.File(out, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array(VERSION)
        root.attrs.create("Type", np.bytes_("UnstructuredGrid"))
        parts = _write_meshes(root, points, cells, kind, by_cell)
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = table.rows
        times = np.arange(table.rows, dtype=np.float64)
        steps["Values"] = times / options.fps if options.fps else times
        steps["NumberOfParts"] = np.ones(table.rows, np.int64)
        steps["PartOffsets"] = parts.place
        steps["PointOffsets"] = parts.starts("Points")
        for name in ("Cell", "ConnectivityId"):
            steps[f"{name}Offsets"] = parts.starts(f"{name}s")[:, None]
        meshes = {each.field.name: each for each in (points, cells) if each is not None}
        for place, names in _share(table, points, cells, set(meshes)).items():
            sizes = parts.sizes["Points" if place == "PointData" else "Cells"][parts.place]
            for name in names:
                stored = _Growing(root, f"{place}/{name}")
                for row, values in enumerate(_each(table.fields[name], table)):
                    data = _as_data(values)
                    if len(data) != sizes[row]:
                        raise ExchangeError(
                            f'"{name}" has {len(data)} values in row {row}, but the mesh '
                            f"{sizes[row]}."
                        )
                    stored.append(data)
                stored.close()
                steps[f"{place}Offsets/{name}"] = np.cumsum(sizes) - sizes
    return 0


@dataclass(frozen=True)
class _Parts:
    """The meshes of a file.

    Attributes:
        sizes: Numbers of points, cells and ends of cells of each mesh, by what they are.
        place: The mesh of each row.
    """

    sizes: Mapping[str, Index]
    place: Index

    def starts(self, what: str) -> Index:
        """Return how many points, cells or ends of cells are before the mesh of each row."""
        found: Index = (np.cumsum(self.sizes[what]) - self.sizes[what])[self.place]
        return found


def _write_meshes(root: Any, points: _Mesh, cells: _Mesh | None, kind: int, by_cell: int) -> _Parts:
    """Write each mesh: of each episode, or of each row if points or cells change with it."""
    same = cells is None or np.array_equal(points.place, cells.place)
    count = int(points.place.max(initial=-1)) + 1 if same else len(points.place)
    sizes = {name: np.empty(count, np.int64) for name in ("Points", "Cells", "ConnectivityIds")}
    names = ("Points", "Connectivity", "Offsets", "Types")
    at, links, ends, types = (_Growing(root, name) for name in names)
    others = itertools.repeat(None) if cells is None else cells.values(by_row=not same)
    meshes = zip(range(count), points.values(by_row=not same), others, strict=False)
    for part, nodes, corners in meshes:
        at.append(_as_vectors(nodes))
        if corners is None or cells is None:
            corners = np.arange(len(nodes))[:, None]
        else:
            _check(corners, len(nodes), cells.field)
        links.append(corners.reshape(-1).astype(np.int64))
        ends.append(np.arange(len(corners) + 1, dtype=np.int64) * by_cell)
        types.append(np.full(len(corners), kind, np.uint8))
        for name, size in (("Points", len(nodes)), ("Cells", len(corners))):
            sizes[name][part] = size
        sizes["ConnectivityIds"][part] = corners.size
    for stored in (at, links, ends, types):
        stored.close()
    for name, of in sizes.items():
        root[f"NumberOf{name}"] = of
    return _Parts(sizes, points.place if same else np.arange(count))


class _Growing:
    """An array of a file that grows; what is added is kept until it is worth writing."""

    def __init__(self, root: Any, name: str) -> None:
        self._root, self._name = root, name
        self._stored: Any = None
        self._waiting: list[Array] = []

    def append(self, values: Array) -> None:
        """Add entries to the end."""
        self._waiting.append(values)
        if sum(each.nbytes for each in self._waiting) > BLOCK:
            self.close()

    def close(self) -> None:
        """Write what was kept."""
        if not self._waiting:
            return
        values, self._waiting = np.concatenate(self._waiting), []
        if self._stored is None:
            shape = values.shape[1:]
            rows = max(1, _CHUNK // max(1, values.itemsize * math.prod(shape)))
            self._stored = self._root.create_dataset(
                self._name,
                (0, *shape),
                values.dtype,
                maxshape=(None, *shape),
                chunks=(rows, *shape),
            )
        end = len(self._stored)
        self._stored.resize(end + len(values), axis=0)
        self._stored[end:] = values


def _each(field: Field, table: Table) -> Iterator[Array]:
    """Yield the value of each row."""
    for _, block in table.column(field.name, _FREE_ROWS if field.free_axis else None):
        yield from block


def _find(table: Table, episodes: Table | None, what: str, name: str | None) -> _Mesh:
    """Return the field that has the points or the cells, of rows or of episodes."""
    own = {n: f for n, f in table.fields.items() if len(f.shape or ()) == 2}
    once = {} if episodes is None else {
        n: f for n, f in episodes.fields.items() if f.role == "episode" and len(f.shape or ()) == 2
    }  # fmt: skip
    if name is None or name not in (own | once):
        wrong = "" if name is None else f' It has no field "{name}" of such a shape.'
        hint = "" if name is None else nearest(name, own | once)
        raise ConfigError(
            f"vtkhdf needs the field with the {what} of the mesh, of shape (number, numbers of "
            f"each): {what} (--{what} on the command line).{wrong}{hint} Such fields: "
            f"{listed(own | once)}."
        )
    if name in own:
        return _Mesh(own[name], table, np.arange(table.rows))
    assert episodes is not None
    mine = np.flatnonzero(episodes.view["mode_index"][:] == MODES.index(table.mode))
    place = np.repeat(mine, episodes.view["rows"][:][mine])
    if len(place) != table.rows:
        raise ExchangeError(
            f"{len(place)} rows have records of episodes, but the mode has {table.rows}: rows "
            f'without a record have no "{name}".'
        )
    return _Mesh(once[name], episodes, place)


def _cell_type(options: ExportOptions, points: Field, cells: Field | None) -> tuple[int, int]:
    """Return the number of the cells' type in VTK, and the number of points of each."""
    size = (points.shape or (0, 0))[1]
    if size not in (1, 2, 3):
        raise ConfigError(f'"{points.name}" has {size} numbers for each point, not 1 to 3.')
    if cells is None:
        return CELLS["vertex"]
    by_cell = (cells.shape or (0, 0))[1]
    guess = "quad" if size == 2 else "tetra"
    name = options.cell_type or (guess if by_cell == 4 else _GUESSED.get(by_cell))
    if name not in CELLS or CELLS[name][1] != by_cell:
        raise ConfigError(
            f'"{cells.name}" has {by_cell} points for each cell, which is no '
            f"{name or 'known cell'}: choose a cell_type (--cell-type on the command line) of "
            f"{listed(CELLS)}."
        )
    if cells.numpy_dtype.kind not in "iu":
        raise ConfigError(f'"{cells.name}" has no numbers of points, but {cells.numpy_dtype}.')
    return CELLS[name]


def _share(
    table: Table, points: _Mesh, cells: _Mesh | None, meshes: Collection[str]
) -> dict[str, list[str]]:
    """Return the fields that are data of points or of cells; tell which are neither."""
    sizes = {"PointData": points.field.shape}
    sizes["CellData"] = (points if cells is None else cells).field.shape
    found: dict[str, list[str]] = {place: [] for place in sizes}
    left = []
    for name, field in table.fields.items():
        shape = field.shape or ()
        place = next(
            (p for p, size in sizes.items() if shape and shape[:1] == (size or ())[:1]), None
        )
        if name in meshes:
            continue
        if place is None or field.numpy_dtype.kind not in "biuf":
            left.append(name)
        else:
            found[place].append(name)
    if left:
        warnings.warn(
            f"{listed(left)} are left out of the VTKHDF file: they have no value for each point or "
            "cell.",
            stacklevel=2,
        )
    return found


def _as_vectors(values: Array) -> Array:
    """Return points of 1 to 3 numbers as points in space, shape (points, 3)."""
    kind = np.result_type(values.dtype, np.float32)
    return np.pad(values, ((0, 0), (0, _SPACE - values.shape[1]))).astype(kind, copy=False)


def _as_data(values: Array) -> Array:
    """Return a number or several for each point, shape (points,) or (points, numbers)."""
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    flat = values.reshape(len(values), -1)
    if flat.shape[1] == 1:
        return flat[:, 0]
    return np.pad(flat, ((0, 0), (0, 1))) if flat.shape[1] == 2 else flat


def _check(corners: Array, count: int, field: Field) -> None:
    if corners.size and (corners.min() < 0 or corners.max() >= count):
        raise ExchangeError(
            f'"{field.name}" names points from {corners.min()} to {corners.max()}, but there are '
            f"{count}, numbered from 0."
        )


FORMAT = Format(
    write=write,
    loses=("way back", "records"),
    several=True,
    options=("points", "cells", "cell_type", "fps"),
    free_axes=True,
)
