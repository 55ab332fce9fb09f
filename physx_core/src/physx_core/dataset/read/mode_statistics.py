"""Statistics of a mode's rows: computed once per partition and merged when it is sealed.

`physx_core.dataset.read.ordered_statistics` has those of a mode with episodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from physx_core.dataset.read.ordered_statistics import Statistics, compute_in_order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store import statistics_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.statistics import RunningStatistics


def compute_statistics(reader: Reader, mode_name: str) -> Statistics:
    """Return the statistics of a mode's floating-point fields over all its committed rows."""
    mode, order = reader.mode(mode_name), reader.order(mode_name)
    if order is not None:
        return compute_in_order(reader, mode_name, order)
    statistics_file.load(reader.directory, reader.manifest)
    for partition in mode.partitions:
        if not partition.counted:
            _update_running(reader, mode, partition)
    for partition in count_sealed(reader.directory, reader.manifest, mode, mode.partitions):
        mode.swap(partition)
    found = mode.statistics or {}
    for partition in mode.partitions:
        if not partition.counted:
            found = merge_statistics(found, partition.running)
    return found


def count_sealed(
    directory: Path, manifest: Manifest, mode: Mode, partitions: Iterable[Partition]
) -> list[Partition]:
    """Merge the complete statistics of sealed partitions into those of the mode.

    They are merged in the order of the rows, and stored with the next change of the manifest.
    Partitions with rows that were updated in place are left out until they have checksums again,
    as the rows may not have reached the disk yet.

    Returns:
        The partitions that count now, for the manifest.
    """
    statistics_file.load(directory, manifest)
    counted = []
    for partition in partitions:
        have = (partition.running.get(name) for name in mode.counted_fields)
        complete = all(s is not None and s.count == partition.rows for s in have)
        if partition.checksums and not partition.counted and complete:
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


def _update_running(reader: Reader, mode: Mode, partition: Partition) -> None:
    """Bring the running statistics of a partition up to its last committed row."""
    for name in mode.counted_fields:
        statistics = partition.running.setdefault(name, RunningStatistics())
        for block in reader.partition_blocks(partition, name, statistics.count):
            statistics.update(block)
