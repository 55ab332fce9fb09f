"""The file with the statistics of the cells of modes with episodes: see `KeptCells`.

It holds them as arrays named ``<mode>/<field>/<column>``. Its name ends in its CRC-32; it never
changes, and a newer one replaces it. Nothing refers to it: a missing or damaged file, or one of
other rows, only means that the statistics are computed from the rows.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.array_file import pack, unpack
from physx_core.dataset.store.manifest import Mode
from physx_core.fields import Field
from physx_core.statistics import Cells
from physx_core.typing import Array, Index

_NAME = re.compile(r"order_([0-9a-f]{8})\.safetensors(\.tmp)?")
_LARGEST = 2**32

Keys = NDArray[np.uint64]


class KeptCells(NamedTuple):
    """Statistics of sets of rows, and what identifies the rows of each.

    Attributes:
        keys: Identifies the rows of each cell; ascending.
        cells: Their statistics.
    """

    keys: Keys
    cells: Cells

    @classmethod
    def of(cls, keys: Keys, cells: Cells) -> KeptCells:
        """Return those of some cells that have a key, which is not 0."""
        known, place = np.unique(keys, return_index=True)
        chosen = place[known != 0]
        return cls(known[known != 0], cells.take(chosen))

    def places(self, keys: Keys, counts: Index | None) -> Index:
        """Return the places of cells with some keys and numbers of rows; -1: they are unknown.

        Args:
            keys: The keys.
            counts: The numbers of rows; None: any.
        """
        if not len(self.keys):
            return np.full(len(keys), -1)
        place = np.minimum(self.keys.searchsorted(keys), len(self.keys) - 1)
        right = self.keys[place] == keys
        if counts is not None:
            right &= self.cells.rows[place] == counts
        return np.where(right, place, -1)


def nothing(field: Field, pooled: tuple[int, ...] | None = None) -> KeptCells:
    """Return no cells of a field, whose statistics are pooled over some axes, or as kept."""
    axes = field.pooled if pooled is None else pooled
    none = np.zeros((*field.pooled_shape(axes), 0))
    return KeptCells(np.zeros(0, np.uint64), Cells(np.zeros(0, np.int64), *(none,) * 4))


def write(directory: Path, kept: Mapping[tuple[str, str], KeptCells]) -> None:
    """Write statistics by mode and field, unless they are there; wait until they are on disk."""
    arrays: dict[str, Array] = {}
    for (mode, name), (keys, cells) in kept.items():
        columns = {"keys": keys, **cells._asdict()}
        arrays |= {f"{mode}/{name}/{column}": array for column, array in columns.items()}
    content = pack(arrays)
    path = directory / f"order_{crc32(content):08x}.safetensors"
    if not path.exists():
        files.replace(path, content)
    for other in _all(directory):
        if other != path:
            with contextlib.suppress(OSError):
                files.remove(other)


def read(directory: Path, modes: Mapping[str, Mode]) -> dict[tuple[str, str], KeptCells]:
    """Return the statistics that can be read, by mode and field."""
    for path in _all(directory):
        with contextlib.suppress(OSError, ValueError, MemoryError):
            content = files.read_content(path, _LARGEST)
            if path.name == f"order_{crc32(content):08x}.safetensors":
                return _parse(unpack(content), modes)
    return {}


def _all(directory: Path) -> Iterator[Path]:
    return (path for path in sorted(directory.glob("order_*")) if _NAME.fullmatch(path.name))


def _parse(
    arrays: Mapping[str, Array], modes: Mapping[str, Mode]
) -> dict[tuple[str, str], KeptCells]:
    found = {}
    for mode_name, mode in modes.items():
        for name, field in mode.counted_fields.items():
            parts = [arrays.get(f"{mode_name}/{name}/{c}") for c in ("keys", *Cells._fields)]
            if field.shape is not None and (kept := _checked(field, parts)) is not None:
                found[mode_name, name] = kept
    return found


def _checked(field: Field, columns: list[Array | None]) -> KeptCells | None:
    """Return cells of a field whose columns come from a file; None if they are not such cells."""
    wanted = nothing(field)
    kinds = [wanted.keys, *wanted.cells]
    known = [array for array in columns if array is not None]
    if len(known) != len(kinds) or len({array.shape[-1:] for array in known}) != 1:
        return None
    if any(
        a.dtype != kind.dtype or a.shape[:-1] != kind.shape[:-1]
        for a, kind in zip(known, kinds, strict=True)
    ):
        return None
    keys, rows, mean, squares, least, most = known
    enough = (rows >= 0 if field.free_axis else rows > 0).all()
    right = (np.diff(keys) > 0).all() and enough and (squares >= 0).all()
    if not (right and all(np.isfinite(array).all() for array in (mean, least, most))):
        return None
    return KeptCells(keys, Cells(rows, mean, squares, least, most))
