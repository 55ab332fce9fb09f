"""The file with the statistics of a dataset's rows, beside the manifest.

It holds count, mean, sum of squared deviations, minimum and maximum of each component, as arrays
named ``<mode>/<field>/<statistic>``, over the rows of the partitions that the manifest marks as
counted. Its name ends in its CRC-32. It never changes: new statistics go into a new file, which is
on the disk before the manifest refers to it, and the old file is removed after that.

Everything in it can be recomputed from the rows. A lost or damaged file is therefore no error: its
statistics are computed from the rows when they are needed.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from pathlib import Path

from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.array_file import pack, unpack
from physx_core.dataset.store.manifest import Manifest, Mode
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array

_NAME = re.compile(r"statistics_[0-9a-f]{8}\.safetensors(\.tmp)?")
_ARRAYS = 5
_NUMBER = 8
_HEADER = 2**20
_PER_FIELD = 2**12


def file_name(checksum: int) -> str:
    """Return the name of the file with a CRC-32."""
    return f"statistics_{checksum:08x}.safetensors"


def reference(checksum: int) -> dict[str, str]:
    """Return what the manifest says of the file with a CRC-32."""
    return {"file": file_name(checksum), "crc32": f"{checksum:08x}"}


def write(directory: Path, manifest: Manifest) -> int | None:
    """Write the statistics of all modes to a new file and wait until it is on the disk.

    Returns:
        Its CRC-32; None if there are no statistics, and hence no file.
    """
    arrays = {
        f"{mode_name}/{name}/{part}": array
        for mode_name, mode in manifest.modes.items()
        for name, statistics in (mode.statistics or {}).items()
        if statistics.count
        for part, array in statistics.arrays().items()
    }
    if not arrays:
        return None
    content = pack(arrays)
    checksum: int = crc32(content)
    files.replace(directory / file_name(checksum), content)
    return checksum


def load(directory: Path, manifest: Manifest) -> None:
    """Read the statistics that are still only in the file; modes without them forget theirs."""
    if all(mode.statistics is not None for mode in manifest.modes.values()):
        return
    arrays: dict[str, dict[str, dict[str, Array]]] = {}
    with contextlib.suppress(OSError, ValueError, MemoryError):
        for path, array in unpack(read(directory, manifest)).items():
            mode_name, name, part = path.split("/")
            arrays.setdefault(mode_name, {}).setdefault(name, {})[part] = array
    for mode_name, mode in manifest.modes.items():
        if mode.statistics is None:
            mode.statistics = _find(mode, arrays.get(mode_name, {}))
            if mode.statistics is None:
                mode.forget_statistics()


def read(directory: Path, manifest: Manifest) -> bytes:
    """Return the content of the file.

    Raises:
        OSError: If it is missing or cannot be read.
        ValueError: If it is damaged.
    """
    fields = [of for mode in manifest.modes.values() for of in mode.counted_fields.values()]
    most = _HEADER + sum(
        _PER_FIELD + _ARRAYS * _NUMBER * of.nbytes for of in fields if of.shape is not None
    )
    content = files.read_content(directory / file_name(manifest.statistics_checksum or 0), most)
    if crc32(content) != manifest.statistics_checksum:
        raise ValueError("its checksum does not match")
    return content


def remove(directory: Path, checksum: int | None) -> None:
    """Remove the file with a CRC-32, which nothing refers to any more."""
    if checksum is not None:
        with contextlib.suppress(OSError):
            files.remove(directory / file_name(checksum))


def clear(directory: Path, checksum: int | None) -> None:
    """Remove the files that the manifest no longer refers to, and drafts.

    Args:
        directory: The dataset's folder.
        checksum: CRC-32 of the file that stays.
    """
    kept = None if checksum is None else file_name(checksum)
    for path in directory.glob("statistics_*"):
        if _NAME.fullmatch(path.name) and path.name != kept:
            with contextlib.suppress(OSError):
                files.remove(path)


def _find(
    mode: Mode, arrays: Mapping[str, Mapping[str, Array]]
) -> dict[str, RunningStatistics] | None:
    """Return the statistics of a mode if they are those of its counted rows, otherwise None."""
    parts, found = [p for p in mode.partitions if p.counted], {}
    for name, of in mode.counted_fields.items() if any(p.rows for p in parts) else ():
        counted = sum(p.rows_of(of) for p in parts)
        try:
            found[name] = RunningStatistics.from_arrays(arrays.get(name, {}), of.statistics_shape)
        except ValueError:
            return None
        if found[name].count != counted:
            return None
    return found
