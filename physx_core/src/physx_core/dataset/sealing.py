"""Sealing: giving a finished partition its final form."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np

from physx_core.dataset import files
from physx_core.dataset.layout import inspect
from physx_core.dataset.manifest import Mode, Partition
from physx_core.dataset.partition import rewrite
from physx_core.dataset.reader import Reader, Segment
from physx_core.errors import DatasetError
from physx_core.fields import RESERVED
from physx_core.statistics import RunningStatistics

_BLOCK = 2**22


def seal(directory: Path, mode_name: str, mode: Mode, partition: Partition) -> None:
    """Rewrite a partition's files at their exact size, if they are not full, and checksum them.

    A process that dies meanwhile leaves files that hold all the rows, some in their final form.

    Args:
        directory: The dataset's folder.
        mode_name: Name of the mode.
        mode: The mode.
        partition: What to seal; nothing writes to it any more.

    Raises:
        DatasetError: A file is missing or damaged.
        OSError: A file cannot be rewritten; the partition stays as it is, unsealed.
    """
    for name, field in mode.fields.items():
        path = directory / partition.file_name(mode_name, name)
        found = inspect(path, partition.offsets.get(name), field.nbytes)
        offset = found.data_offset
        if found.capacity != partition.rows or found.rows != partition.rows:
            identity = partition.identity(mode_name, field)
            offset = rewrite(path, identity, partition.rows, offset)
        partition.offsets[name] = offset
        rows = Segment(path, 0, partition.rows, offset, certain=True)
        partition.checksums[name] = checksum(rows, field.nbytes)
    files.sync_folder(directory)
    partition.sealed, partition.writing = True, False


def checksum(segment: Segment, row_nbytes: int) -> int:
    """Return the CRC-32 of a segment's bytes.

    Raises:
        DatasetError: The file is missing, truncated or damaged.
    """
    crc, left = 0, segment.rows * row_nbytes
    buffer = memoryview(bytearray(min(left, _BLOCK)))
    file, place = segment.open(row_nbytes)
    with file:
        while left:
            part = buffer[:left]
            if not files.read_at(file.fileno(), part, place):
                raise DatasetError(f"{segment.path} became shorter while it was read.")
            crc = zlib.crc32(part, crc)
            left, place = left - len(part), place + len(part)
    return crc


def remove_files(directory: Path, mode_name: str, mode: Mode, partition: Partition) -> None:
    """Remove the files of a partition that has no committed row."""
    for name in mode.fields:
        (directory / partition.file_name(mode_name, name)).unlink(missing_ok=True)


def cover(reader: Reader, mode_name: str) -> None:
    """Bring the statistics of a mode's floating fields up to its last committed row.

    Args:
        reader: Reads the rows that are not covered yet.
        mode_name: Name of the mode.

    Raises:
        DatasetError: A partition is missing or damaged.
    """
    mode = reader.mode(mode_name)
    for name, field in mode.fields.items():
        if name in RESERVED or np.dtype(field.dtype).kind != "f":
            continue
        statistics = mode.statistics.setdefault(name, RunningStatistics())
        if statistics.count > mode.rows:
            statistics = mode.statistics[name] = RunningStatistics()
        for block in reader.blocks(mode_name, name, statistics.count):
            statistics.update(block)
