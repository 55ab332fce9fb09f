"""VTKHDF: one file with a mesh, its fields, and a time step for each row, for ParaView and VTK.

The file is HDF5, in version 2.2 of the format. Meshes and fields of the same number of points share
one unstructured grid; a mesh that episodes store once is stored once for each.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
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
from physx_formats.table import ExportOptions, Table

VERSION = (2, 2)
CELLS = {
    "vertex": (1, 1), "line": (3, 2), "triangle": (5, 3), "quad": (9, 4), "tetra": (10, 4),
    "pyramid": (14, 5), "wedge": (13, 6), "hexahedron": (12, 8),
}  # fmt: skip
"""Number of the cell type in VTK, and its number of points."""
_GUESSED = {1: "vertex", 2: "line", 3: "triangle", 5: "pyramid", 6: "wedge", 8: "hexahedron"}
_SPACE = 3


@dataclass(frozen=True)
class _Mesh:
    """A field of points or cells.

    Attributes:
        field: The field.
        blocks: Yields its values, each with the number of the first.
        place: Which of its values each row has, shape (rows,).
    """

    field: Field
    blocks: Iterator[tuple[int, Array]]
    place: Index


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
    count = (points.field.shape or (0,))[0]
    cells = None if options.cells is None else _find(table, episodes, "cells", options.cells)
    kind, by_cell = _cell_type(options, points.field, None if cells is None else cells.field)
    number = count if cells is None else (cells.field.shape or (0,))[0]
    meshes = [each.field.name for each in (points, cells) if each is not None]
    data = _share(table, {"PointData": count, "CellData": number}, meshes)
    with h5py.File(out, "w") as file:
        root = file.create_group("VTKHDF", track_order=True)
        root.attrs["Version"] = np.array(VERSION)
        root.attrs.create("Type", np.bytes_("UnstructuredGrid"))
        sizes = {"Points": count, "Cells": number, "ConnectivityIds": number * by_cell}
        for name, size in sizes.items():
            root[f"NumberOf{name}"] = np.array([size], np.int64)
        _copy(root, "Points", points, _as_vectors)
        if cells is None:
            root["Connectivity"] = np.arange(count, dtype=np.int64)
        else:
            _copy(root, "Connectivity", cells, lambda values: _checked(values, count, cells.field))
        root["Offsets"] = np.arange(number + 1, dtype=np.int64) * by_cell
        root["Types"] = np.full(number, kind, np.uint8)
        steps = _steps(root, table, options.fps)
        for name, values in {
            "PointOffsets": points.place * count,
            "CellOffsets": np.zeros((table.rows, 1), np.int64),
            "ConnectivityIdOffsets": (
                np.zeros((table.rows, 1), np.int64) if cells is None
                else cells.place[:, None] * (number * by_cell)
            ),
        }.items():  # fmt: skip
            steps[name] = values
        for place, names in data.items():
            size = sizes["Points" if place == "PointData" else "Cells"]
            for name in names:
                rows = _Mesh(table.fields[name], table.column(name), np.arange(table.rows))
                _copy(root, f"{place}/{name}", rows, _as_data)
                steps[f"{place}Offsets/{name}"] = rows.place * size
    return 0


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
        return _Mesh(own[name], table.column(name), np.arange(table.rows))
    assert episodes is not None
    mine = np.flatnonzero(episodes.view["mode_index"][:] == MODES.index(table.mode))
    place = np.repeat(mine, episodes.view["rows"][:][mine])
    if len(place) != table.rows:
        raise ExchangeError(
            f"{len(place)} rows have records of episodes, but the mode has {table.rows}: rows "
            f'without a record have no "{name}".'
        )
    return _Mesh(once[name], episodes.column(name), place)


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


def _share(table: Table, sizes: Mapping[str, int], meshes: Sequence[str]) -> dict[str, list[str]]:
    """Return the fields that are data of points or of cells; tell which are neither."""
    found: dict[str, list[str]] = {place: [] for place in sizes}
    left = []
    for name, field in table.fields.items():
        shape = field.shape or ()
        place = next((each for each, size in sizes.items() if shape[:1] == (size,)), None)
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


def _steps(root: Any, table: Table, fps: int | None) -> Any:
    """Write when each row is: in s if there are frames per s, else by its number."""
    steps = root.create_group("Steps")
    steps.attrs["NSteps"] = table.rows
    times = np.arange(table.rows, dtype=np.float64)
    steps["Values"] = times / fps if fps else times
    steps["PartOffsets"] = np.zeros(table.rows, np.int64)
    steps["NumberOfParts"] = np.ones(table.rows, np.int64)
    return steps


def _copy(root: Any, name: str, mesh: _Mesh, convert: Any) -> None:
    """Write all values of a field, end to end."""
    stored, last = None, int(mesh.place.max(initial=0)) + 1
    for start, block in mesh.blocks:
        values = convert(block[: max(0, last - start)])
        size = values.shape[0] // max(1, min(len(block), last - start))
        if stored is None:
            stored = root.create_dataset(name, (last * size, *values.shape[1:]), values.dtype)
        stored[start * size : start * size + len(values)] = values


def _as_vectors(values: Array) -> Array:
    """Return points of 1 to 3 numbers as points in space, shape (points, 3)."""
    flat = values.reshape(-1, values.shape[-1])
    kind = np.result_type(flat.dtype, np.float32)
    return np.pad(flat, ((0, 0), (0, _SPACE - flat.shape[1]))).astype(kind, copy=False)


def _as_data(values: Array) -> Array:
    """Return a number or several for each point, shape (points,) or (points, numbers)."""
    if values.dtype.kind == "b":
        values = values.astype(np.uint8)
    flat = values.reshape(values.shape[0] * values.shape[1], -1)
    if flat.shape[1] == 1:
        return flat[:, 0]
    return np.pad(flat, ((0, 0), (0, 1))) if flat.shape[1] == 2 else flat


def _checked(values: Array, count: int, field: Field) -> Array:
    if values.min(initial=0) < 0 or values.max(initial=0) >= count:
        raise ExchangeError(
            f'"{field.name}" names points from {values.min()} to {values.max()}, but there are '
            f"{count}, numbered from 0."
        )
    return values.reshape(-1).astype(np.int64)


FORMAT = Format(write=write, several=True, options=("points", "cells", "cell_type", "fps"))
