"""Seals open partitions without their damaged rows; all other rows stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from physx_core import files
from physx_core.dataset.store import manifest_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.commits import Range, merge_ranges
from physx_core.dataset.store.partition.file import complement, copy
from physx_core.dataset.store.sealing import scan


def seal_without_damage(
    directory: Path, manifest: Manifest, mode: Mode, group: Sequence[Partition]
) -> None:
    """Replace open partitions by sealed copies without the rows that are damaged in any of them.

    The copies are new partitions: were the files replaced one by one, the rows of some fields would
    be shifted against those of others if the process died in between. There is one for each run of
    sound rows, whose places stay those that the table of episodes speaks of. The originals become
    dropped partitions; their files remain until the manifest is stored.

    Args:
        directory: The dataset's folder.
        manifest: The manifest, without unsaved changes that need other files.
        mode: The mode of the partitions.
        group: Partitions that have stripes of the same rows, or a single one.
    """
    damaged = merge_ranges(chain.from_iterable(partition.damaged for partition in group))
    runs = complement(max(partition.rows for partition in group), damaged)
    pairs = [
        (old, run, _reserve(directory, mode, old, run))
        for run in runs
        for old in group
        if old.rows > run[0]
    ]
    manifest_file.save(directory, manifest)  # whoever comes next removes incomplete copies
    for old, (start, stop), new in pairs:
        for name, field in mode.fields.items():
            offset = old.inspect(directory, field).data_offset
            path, target = old.path(directory, name), new.path(directory, name)
            others = [(0, start), (min(stop, old.rows), old.rows)]
            new.offsets[name], _ = copy(path, offset, target, new.identity(field), old.rows, others)
    files.sync_folder(directory)
    copies = [new for _, _, new in pairs]
    keys = {new.key for new in copies}
    mode.dropped = [partition for partition in mode.dropped if partition.key not in keys]
    place = mode.place(group[0])
    mode.partitions[place:place] = [
        scan(directory, mode.fields, replace(new, sealed=True)) for new in copies
    ]
    for old in group:
        del mode.partitions[mode.place(old)]
        mode.dropped.append(old)


def _reserve(directory: Path, mode: Mode, partition: Partition, run: Range) -> Partition:
    """List the copy of some rows of a partition as dropped, with the next number without files."""
    listed = (*mode.partitions, *mode.dropped)
    used = [each.index for each in listed if each.session == partition.session]
    index = max(*used, mode.removed.get(partition.session, -1)) + 1
    start, stop = run
    new = Partition(
        partition.mode,
        partition.session,
        index,
        partition.first_row + start * (partition.stripe.of if partition.stripe else 1),
        rows=min(stop, partition.rows) - start,
        stripe=partition.stripe,
    )
    while any(new.path(directory, name).exists() for name in mode.fields):
        new = replace(new, index=new.index + 1)
    mode.dropped.append(new)
    return new
