"""Seals open partitions without their damaged rows; all other rows stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

from physx_core import files
from physx_core.dataset.store import manifest_file
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.commits import Range, merge_ranges, within
from physx_core.dataset.store.partition.file import copy
from physx_core.dataset.store.sealing import scan


def seal_without_damage(
    directory: Path, manifest: Manifest, mode: Mode, group: Sequence[Partition]
) -> None:
    """Replace open partitions by sealed copies without the rows that are damaged in any of them.

    The copies are new partitions: were the files replaced one by one, the rows of some fields would
    be shifted against those of others if the process died in between. The originals become dropped
    partitions; their files remain until the manifest is stored.

    Args:
        directory: The dataset's folder.
        manifest: The manifest, without unsaved changes that need other files.
        mode: The mode of the partitions.
        group: Partitions that have stripes of the same rows, or a single one.
    """
    damaged = merge_ranges(chain.from_iterable(partition.damaged for partition in group))
    copies = [_reserve(directory, mode, old, damaged) for old in group]
    manifest_file.save(directory, manifest)  # whoever comes next removes incomplete copies
    pairs = [(old, new) for old, new in zip(group, copies, strict=True) if new.rows]
    for old, new in pairs:
        for name, field in mode.fields.items():
            offset = old.inspect(directory, field).data_offset
            path, target = old.path(directory, name), new.path(directory, name)
            without = within(damaged, old.rows)
            new.offsets[name], _ = copy(
                path, offset, target, new.identity(field), old.rows, without
            )
    files.sync_folder(directory)
    keys = {new.key for new in copies}
    mode.dropped = [partition for partition in mode.dropped if partition.key not in keys]
    for old, new in pairs:
        sealed = scan(directory, mode.fields, replace(new, sealed=True))
        mode.partitions.insert(mode.place(old), sealed)
    for old in group:
        del mode.partitions[mode.place(old)]
        mode.dropped.append(old)


def _reserve(
    directory: Path, mode: Mode, partition: Partition, damaged: Sequence[Range]
) -> Partition:
    """List the copy of a partition as dropped, with the next number without files."""
    listed = (*mode.partitions, *mode.dropped)
    used = [each.index for each in listed if each.session == partition.session]
    index = max(*used, mode.removed.get(partition.session, -1)) + 1
    lost = sum(stop - start for start, stop in within(damaged, partition.rows))
    new = Partition(
        partition.mode,
        partition.session,
        index,
        partition.first_row,
        rows=partition.rows - lost,
        stripe=partition.stripe,
    )
    while any(new.path(directory, name).exists() for name in mode.fields):
        new = replace(new, index=new.index + 1)
    mode.dropped.append(new)
    return new
