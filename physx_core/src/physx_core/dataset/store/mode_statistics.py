"""Statistics of a mode's rows: each partition's are computed once, and merged when it is sealed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store.manifest import Mode, Partition
from physx_core.statistics import RunningStatistics

_BLOCK = 2**20

Statistics = dict[str, RunningStatistics]


def statistics_of(reader: Reader, mode_name: str) -> Statistics:
    """Return the statistics of a mode's floating fields, over all its committed rows.

    Raises:
        DatasetError: There is no such mode, or a partition is missing or damaged.
    """
    mode = reader.mode(mode_name)
    for partition in mode.partitions:
        if not partition.counted:
            run(reader, mode_name, partition)
    settle(mode)
    found = mode.statistics
    for partition in mode.partitions:
        if not partition.counted:
            found = merged(found, partition.running)
    return found


def run(reader: Reader, mode_name: str, partition: Partition) -> None:
    """Bring the running statistics of a partition up to its last committed row.

    Raises:
        DatasetError: The partition is missing or damaged.
    """
    mode = reader.mode(mode_name)
    start = mode.start(partition)
    for name, field in mode.counted_fields.items():
        statistics = partition.running.setdefault(name, RunningStatistics())
        size = max(1, _BLOCK // max(1, field.nbytes))
        left = partition.rows - statistics.count
        buffer = np.empty((max(0, min(size, left)), *(field.shape or ())), field.dtype)
        sums: dict[int, int] = {}
        while left > 0:
            block = buffer[:left]
            reader.read_into(block, mode_name, name, start + statistics.count, sums)
            statistics.update(block)
            left -= len(block)


def settle(mode: Mode) -> None:
    """Merge into the mode's statistics those of sealed partitions that are known completely."""
    for place, partition in enumerate(mode.partitions):
        have = (partition.running.get(name) for name in mode.counted_fields)
        whole = all(s is not None and s.count == partition.rows for s in have)
        if partition.sealed and not partition.counted and whole:
            mode.statistics = merged(mode.statistics, partition.running)
            mode.partitions[place] = replace(partition, counted=True, running={})


def merged(
    one: Mapping[str, RunningStatistics], two: Mapping[str, RunningStatistics]
) -> Statistics:
    """Return the statistics of the rows of both, each left as it is."""
    found = {}
    for name in {**one, **two}:
        total = found[name] = RunningStatistics()
        for part in (one, two):
            if name in part:
                total.merge(part[name])
    return found
