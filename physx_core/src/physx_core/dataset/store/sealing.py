"""Seals partitions: rewrites their files at the exact size and checksums the rows."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from zlib_ng.zlib_ng import crc32

from physx_core import files
from physx_core.dataset.store.manifest import Partition
from physx_core.dataset.store.partition.commits import Commit, encode
from physx_core.dataset.store.partition.file import copy
from physx_core.fields import ENDS, Field, free_axes
from physx_core.statistics import RunningStatistics
from physx_core.typing import Index


def seal(
    directory: Path,
    fields: Mapping[str, Field],
    partition: Partition,
    *,
    rewrite: bool = False,
    statistics: bool = True,
) -> Partition:
    """Rewrite a partition's files at their exact size, unless they are full, and checksum them.

    Everything is on disk when this returns. If the process dies before that, the files still hold
    all rows, some already in their final form.

    Args:
        directory: The dataset's folder.
        fields: The fields that have files.
        partition: The partition; nothing may write to it any more.
        rewrite: Whether to rewrite full files too.
        statistics: Whether to compute those of the rows, which modes with episodes do not use.

    Returns:
        The sealed partition, for the manifest.
    """
    offsets, partition = {}, measure(directory, fields, partition)
    for name, field in fields.items():
        found, rows = partition.inspect(directory, field), partition.rows_of(field)
        offsets[name] = found.data_offset
        path = partition.path(directory, name)
        if rewrite or not found.is_sealed_form(rows):
            identity = partition.identity(field)
            offsets[name], _ = copy(path, found.data_offset, path, identity, rows)
        else:
            files.sync_file(path)
    files.sync_folder(directory)
    sealed = replace(partition, offsets=offsets, sealed=True, writing=False, follows=None)
    return scan(directory, fields, sealed, statistics=statistics)


def measure(directory: Path, fields: Mapping[str, Field], partition: Partition) -> Partition:
    """Return a partition with the numbers of entries of its rows, read from its files."""
    sizes = {}
    for axis in free_axes(fields.values()):
        ends = read_ends(directory, fields[axis + ENDS], partition, max(0, partition.rows - 1))
        sizes[axis] = int(ends[-1]) if len(ends) else 0
    return replace(partition, sizes=sizes) if sizes else partition


def count_rows(
    directory: Path, fields: Mapping[str, Field], partition: Partition, counts: Mapping[str, int]
) -> int:
    """Return how many rows of a partition are complete.

    Args:
        directory: The dataset's folder.
        fields: The fields that have files.
        partition: The partition; its rows are set to those that have ends.
        counts: How many rows each file has, by field; of entries with a free axis.
    """
    axes = free_axes(fields.values())
    partition.rows = min([n for name, n in counts.items() if not fields[name].free_axis], default=0)
    for axis, names in axes.items():
        ends = read_ends(directory, fields[axis + ENDS], partition)
        entries = min(counts[name] for name in names)
        partition.rows = int(ends.searchsorted(entries, "right"))
    return partition.rows


def read_ends(directory: Path, field: Field, partition: Partition, first: int = 0) -> Index:
    """Return the ends of the entries of a partition's rows, from its row `first` on."""
    found = np.empty(max(0, partition.rows - first), field.dtype)
    if len(found):
        segment = partition.segment(directory, field)
        file, offset = segment.open()
        with file:
            segment.read(file, offset + first * field.nbytes, files.as_bytes(found))
    return found.astype(np.intp)


def scan(
    directory: Path, fields: Mapping[str, Field], partition: Partition, *, statistics: bool = True
) -> Partition:
    """Return a sealed partition with checksums and statistics, computed in one pass."""
    crc, running = dict.fromkeys(fields, 0), {}
    for name, field in fields.items():
        counts = statistics and field.has_statistics
        if counts:
            running[name] = RunningStatistics(field.pooled)
        for block in partition.segment(directory, field).blocks():
            crc[name] = crc32(files.as_bytes(block), crc[name])
            if counts:
                running[name].update(block)
    return replace(partition, checksums=crc, running=running, counted=False)


def unseal(directory: Path, fields: Mapping[str, Field], partition: Partition) -> Partition:
    """Remove checksums and digests of a sealed partition's rows, so that they may be updated.

    Files that were full when they were sealed still have the digests of their rows.

    Returns:
        The partition, for the manifest; the files are on disk.
    """
    for name, field in fields.items():
        settled = Commit.unchecked(partition.rows_of(field))
        found = partition.inspect(directory, field)
        if set(found.commits) != {settled}:
            with files.opened(partition.path(directory, name), os.O_WRONLY) as descriptor:
                files.write_at(descriptor, encode(settled), found.rows_offset)
                files.sync(descriptor)
    return replace(partition, checksums={}, counted=False)


def sync_files(directory: Path, fields: Mapping[str, Field], partition: Partition) -> None:
    """Wait until the rows of a partition are on disk."""
    for name in fields:
        files.sync_file(partition.path(directory, name))


def remove_files(directory: Path, fields: Mapping[str, Field], partition: Partition) -> None:
    """Remove the files of a partition that the manifest no longer lists, and sync the folder."""
    for name in fields:
        files.remove(partition.path(directory, name))
    files.sync_folder(directory)
