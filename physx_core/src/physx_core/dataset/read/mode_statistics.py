"""Statistics of a mode's rows: computed once per partition and merged when it is sealed.

`physx_core.dataset.read.ordered_statistics` has those of a mode with episodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path

from physx_core.dataset.read.mode_rows import ModeRows
from physx_core.dataset.read.ordered_statistics import (
    Statistics,
    all_rows,
    compute_in_order,
    compute_of_rows,
    kept_of,
)
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store import statistics_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.normalization import Measured
from physx_core.statistics import RunningStatistics
from physx_core.typing import Index


def compute_statistics(reader: Reader, mode_name: str) -> Statistics:
    """Return the statistics of a mode's floating-point fields over all its committed rows."""
    mode = reader.mode(mode_name)
    if reader.order(mode_name) is not None:
        return compute_in_order(reader, mode_name)
    statistics_file.load(reader.directory, reader.manifest)
    own = {
        partition.key: _update_running(reader, mode, partition)
        for partition in mode.partitions
        if not partition.counted
    }
    for partition in count_sealed(reader.directory, reader.manifest, mode, mode.partitions):
        mode.swap(partition)
    found = mode.statistics or {}
    for partition in mode.partitions:
        if not partition.counted:
            found = merge_statistics(found, own[partition.key])
    return found


def compute_of(
    known: ModeRows, of: Measured, ranges: tuple[Index, Index] | None = None
) -> RunningStatistics:
    """Return statistics of some rows of a mode.

    Args:
        known: The rows of the mode.
        of: The field, and what of it.
        ranges: First rows, ascending, and numbers of rows of the ranges that they consist of; None:
            all rows.
    """
    starts, counts = all_rows(known) if ranges is None else ranges
    reader, is_all = known.reader, int(counts.sum()) == known.reader.rows(known.mode)
    if known.order is None and is_all and of == kept_of(known.fields[of.field]):
        return compute_statistics(reader, known.mode).get(of.field, RunningStatistics())
    return compute_of_rows(known, of, starts, counts)


def count_sealed(
    directory: Path, manifest: Manifest, mode: Mode, partitions: Iterable[Partition]
) -> list[Partition]:
    """Merge the complete statistics of sealed partitions into those of the mode.

    They are merged in the order of the rows, and stored with the next change of the manifest.
    Partitions with rows that were updated in place are left out, with those after them, until they
    have checksums again, as the rows may not have reached the disk yet.

    Args:
        directory: Folder of the dataset.
        manifest: Its manifest.
        mode: The mode.
        partitions: Consecutive ones; those before them are counted.

    Returns:
        The partitions that count now, for the manifest.
    """
    statistics_file.load(directory, manifest)
    counted = []
    for partition in partitions:
        complete = all(
            (found := partition.running.get(name)) is not None
            and found.count == partition.rows_of(field)
            for name, field in mode.counted_fields.items()
        )
        if partition.counted:
            continue
        if not (partition.checksums and complete):
            break
        add_counted(manifest, mode, partition.running)
        counted.append(replace(partition, counted=True, running={}))
    return counted


def add_counted(manifest: Manifest, mode: Mode, further: Mapping[str, RunningStatistics]) -> None:
    """Merge statistics of further rows into those of a mode, which have been loaded."""
    mode.statistics = merge_statistics(mode.statistics or {}, further)
    manifest.statistics_checksum = None


def merge_statistics(
    one: Mapping[str, RunningStatistics], two: Mapping[str, RunningStatistics]
) -> Statistics:
    """Return the statistics of the rows of both; neither is changed."""
    found = {}
    for name in {**one, **two}:
        total = found[name] = RunningStatistics()
        for part in (one, two):
            if name in part:
                total.merge(part[name])
    return found


def _update_running(reader: Reader, mode: Mode, partition: Partition) -> Statistics:
    """Bring the statistics of a partition up to its last row, and return them.

    While it may grow, whole blocks are kept: when they are asked for makes no difference.
    """
    found = {}
    for name, field in mode.counted_fields.items():
        running = partition.running.setdefault(name, RunningStatistics(field.pooled))
        for block in reader.partition_blocks(partition, name, running.count):
            if len(block) < rows_per_block(field.nbytes) and not partition.sealed:
                running = copy(running)
            running.update(block)
        found[name] = running
    return found
