"""The file with the statistics of the rows of modes with episodes, in order: see `Prefix`.

It holds them as arrays named ``<mode>/<field>/<statistic>``; ``<mode>/rows`` and ``<mode>/key`` say
of which rows they are. Its name ends in its CRC-32; it never changes, and a newer one
replaces it. Nothing refers to it: a missing or damaged file, or one of other rows, only means that
the statistics are computed from the rows.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.array_file import pack, unpack
from physx_core.dataset.store.manifest import Mode
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array

_NAME = re.compile(r"order_([0-9a-f]{8})\.safetensors(\.tmp)?")
_LARGEST = 2**32


@dataclass
class Prefix:
    """The statistics of the first rows of a mode, in order.

    Attributes:
        rows: The number of rows that `key` identifies.
        key: Identifies the rows.
        whole: Statistics of those of them that fill whole cells of the grid, by field.
    """

    rows: int = 0
    key: int = 0
    whole: dict[str, RunningStatistics] = field(default_factory=dict)


def write(directory: Path, prefixes: Mapping[str, Prefix]) -> None:
    """Write the statistics of all modes, unless they are there, and wait until they are on disk."""
    arrays: dict[str, Array] = {}
    for mode, prefix in prefixes.items():
        arrays[f"{mode}/rows"] = np.array(prefix.rows, np.int64)
        arrays[f"{mode}/key"] = np.array(prefix.key, np.uint64)
        for name, statistics in prefix.whole.items():
            if statistics.count:
                known = statistics.arrays().items()
                arrays |= {f"{mode}/{name}/{part}": array for part, array in known}
    content = pack(arrays)
    path = directory / f"order_{crc32(content):08x}.safetensors"
    if not path.exists():
        files.replace(path, content)
    for other in _all(directory):
        if other != path:
            with contextlib.suppress(OSError):
                files.remove(other)


def read(directory: Path, modes: Mapping[str, Mode]) -> dict[str, Prefix]:
    """Return the statistics of modes that can be read."""
    for path in _all(directory):
        with contextlib.suppress(OSError, ValueError, MemoryError):
            content = files.read_content(path, _LARGEST)
            if path.name == f"order_{crc32(content):08x}.safetensors":
                return _parse(unpack(content), modes)
    return {}


def _all(directory: Path) -> Iterator[Path]:
    return (path for path in sorted(directory.glob("order_*")) if _NAME.fullmatch(path.name))


def _parse(arrays: Mapping[str, Array], modes: Mapping[str, Mode]) -> dict[str, Prefix]:
    found = {}
    for mode_name, mode in modes.items():
        rows, key = (arrays.get(f"{mode_name}/{part}") for part in ("rows", "key"))
        if rows is None or key is None or rows.shape or key.shape:
            continue
        prefix = found[mode_name] = Prefix(int(rows), int(key))
        for name, of in mode.counted_fields.items():
            parts = {
                path.split("/")[2]: array
                for path, array in arrays.items()
                if path.startswith(f"{mode_name}/{name}/")
            }
            if parts:
                prefix.whole[name] = RunningStatistics.from_arrays(parts, of.shape or ())
    return found
