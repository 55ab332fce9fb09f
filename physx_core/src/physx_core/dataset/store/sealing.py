"""Sealing: giving a finished partition its final form."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from physx_core import files
from physx_core.dataset.read.reader import Segment
from physx_core.dataset.store.checksums import crc32
from physx_core.dataset.store.manifest import Mode, Partition, has_statistics
from physx_core.dataset.store.partition_file import rewrite
from physx_core.dataset.store.partition_format import inspect
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.statistics import RunningStatistics
from physx_core.typing import Array

_BLOCK = 2**20


def seal(
    directory: Path, mode_name: str, fields: Mapping[str, Field], partition: Partition
) -> Partition:
    """Rewrite a partition's files at their exact size, if they are not full, and checksum them.

    A process that dies meanwhile leaves files that hold all the rows, some in their final form.

    Args:
        directory: The dataset's folder.
        mode_name: Name of the mode.
        fields: The fields of the mode.
        partition: What to seal; nothing writes to it any more.

    Returns:
        The sealed partition, for the manifest.

    Raises:
        DatasetError: A file is missing or damaged.
        OSError: A file cannot be rewritten; all rows are still there.
    """
    offsets = {}
    for name, field in fields.items():
        path = directory / partition.file_name(mode_name, name)
        found = inspect(path, partition.offsets.get(name), field.nbytes)
        offsets[name] = found.data_offset
        if found.capacity != partition.rows or found.rows != partition.rows:
            identity = partition.identity(mode_name, field)
            offsets[name] = rewrite(path, identity, partition.rows, found.data_offset)
    files.sync_folder(directory)
    sealed = replace(partition, offsets=offsets, sealed=True, writing=False)
    return scanned(directory, mode_name, fields, sealed)


def scanned(
    directory: Path, mode_name: str, fields: Mapping[str, Field], partition: Partition
) -> Partition:
    """Return a sealed partition with checksums and statistics of its rows, read once for both.

    Raises:
        DatasetError: A file is missing, truncated or damaged.
    """
    crc, running = {}, {}
    for name, field in fields.items():
        path = directory / partition.file_name(mode_name, name)
        rows = Segment(path, 0, partition.rows, partition.offsets[name], certain=True)
        statistics = running[name] = RunningStatistics()
        crc[name] = 0
        for block in _blocks(rows, field):
            crc[name] = crc32(files.raw(block), crc[name])
            if has_statistics(field):
                statistics.update(block)
    return replace(partition, checksums=crc, running=running, counted=False)


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
            crc = crc32(part, crc)
            left, place = left - len(part), place + len(part)
    return crc


def _blocks(rows: Segment, field: Field) -> Iterator[Array]:
    """Yield the rows of a segment in blocks, each valid until the next."""
    count = max(1, _BLOCK // max(1, field.nbytes))
    buffer = np.empty((min(count, rows.rows), *(field.shape or ())), field.dtype)
    file, place = rows.open(field.nbytes)
    with file:
        for first in range(0, rows.rows, count):
            block = buffer[: rows.rows - first]
            if not files.read_at(file.fileno(), files.raw(block), place + first * field.nbytes):
                raise DatasetError(f"{rows.path} became shorter while it was read.")
            yield block


def sync_files(directory: Path, mode_name: str, mode: Mode, partition: Partition) -> None:
    """Bring the rows of a partition to the disk."""
    for name in mode.fields:
        descriptor = files.open_regular(directory / partition.file_name(mode_name, name))
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)


def remove_files(directory: Path, mode_name: str, mode: Mode, partition: Partition) -> None:
    """Remove the files of a partition that the manifest does not list any more."""
    for name in mode.fields:
        (directory / partition.file_name(mode_name, name)).unlink(missing_ok=True)
