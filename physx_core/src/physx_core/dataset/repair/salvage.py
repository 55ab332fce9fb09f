"""Seals open partitions without their damaged rows; all other rows stay."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from physx_core import files
from physx_core.dataset.store import manifest_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.commits import Range
from physx_core.dataset.store.partition.file import complement, copy
from physx_core.dataset.store.sealing import measure, read_ends, scan
from physx_core.fields import ENDS
from physx_core.typing import Index


def seal_without_damage(
    directory: Path, manifest: Manifest, mode: Mode, partition: Partition
) -> None:
    """Replace an open partition by sealed copies without the rows that are damaged in any field.

    The copies are new partitions: were the files replaced one by one, the rows of some fields would
    be shifted against those of others if the process died in between. There is one for each run of
    sound rows, whose places stay those that the table of episodes speaks of. The original becomes
    a dropped partition; its files remain until the manifest is stored.

    Args:
        directory: The dataset's folder.
        manifest: The manifest, without unsaved changes that need other files.
        mode: The mode of the partition.
        partition: The partition.
    """
    runs = complement(partition.rows, partition.damaged)
    pairs = [(run, _reserve(directory, mode, partition, run)) for run in runs]
    manifest_file.save(directory, manifest)  # whoever comes next removes incomplete copies
    for (start, stop), new in pairs:
        begin = _entries(directory, mode, partition, start)
        end = _entries(directory, mode, partition, stop)
        new.sizes = {axis: end[axis] - begin[axis] for axis in mode.axes}
        for name, field in mode.files.items():
            offset = partition.inspect(directory, field).data_offset
            path, target = partition.path(directory, name), new.path(directory, name)
            axis, count = field.free_axis, partition.rows_of(field)
            first, last = (begin[axis], end[axis]) if axis else (start, stop)
            others = [(0, first), (last, count)]
            new.offsets[name], _ = copy(path, offset, target, new.identity(field), count, others)
            if name in mode.ends:
                ends = read_ends(directory, field, partition)[start:stop]
                _write(target, new.offsets[name], ends - begin[name.removesuffix(ENDS)])
    files.sync_folder(directory)
    copies = [new for _, new in pairs]
    keys = {new.key for new in copies}
    mode.dropped = [partition for partition in mode.dropped if partition.key not in keys]
    sealed = [scan(directory, mode.files, replace(new, sealed=True)) for new in copies]
    mode.partitions.exchange(mode.place(partition), 1, sealed)
    mode.dropped.append(partition)


def _entries(directory: Path, mode: Mode, partition: Partition, rows: int) -> dict[str, int]:
    """Return how many entries the first rows of a partition have, by free axis."""
    return measure(directory, mode.files, replace(partition, rows=rows)).sizes


def _write(path: Path, offset: int, ends: Index) -> None:
    """Store where the entries of a copied partition's rows end there."""
    with files.opened(path, os.O_WRONLY) as descriptor:
        files.write_at(descriptor, files.as_bytes(ends.astype("<u8")), offset)
        files.sync(descriptor)


def _reserve(directory: Path, mode: Mode, partition: Partition, run: Range) -> Partition:
    """List the copy of some rows of a partition as dropped, with the next number without files."""
    index = mode.next_index(partition.session)
    start, stop = run
    new = Partition(
        partition.mode,
        partition.session,
        index,
        partition.first_row + start,
        rows=stop - start,
    )
    while any(new.path(directory, name).exists() for name in mode.files):
        new = replace(new, index=new.index + 1)
    mode.dropped.append(new)
    return new
