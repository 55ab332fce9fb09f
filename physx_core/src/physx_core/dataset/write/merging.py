"""Taking whole partitions into a dataset, and out of it.

In both cases one step of the manifest decides: the files of partitions that come or go are listed
as dropped, so that whoever opens the dataset after a crash removes what is left of them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from physx_core.dataset.store import mode_statistics as coverage
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition_file import copy
from physx_core.dataset.store.partition_format import inspect
from physx_core.dataset.store.sealing import remove_files
from physx_core.dataset.write.writer import Writer
from physx_core.errors import DatasetError

Pairs = list[tuple[Partition, Partition]]


def take_partitions(writer: Writer, source: Path, given: Manifest) -> None:
    """Copy all partitions of another dataset; afterwards all of its rows are there, or none.

    Args:
        writer: Writes the dataset; nothing is open in the modes that get rows, which have the
            other's fields.
        source: Folder of the other dataset.
        given: What the other dataset holds.

    Raises:
        DatasetError: A partition of the other is missing or damaged.
        OSError: The disk is full or fails; nothing has changed.
    """
    pairs = _reserve(writer, given)
    try:
        for name, partitions in pairs.items():
            for old, new in partitions:
                _copy_files(writer.store.directory, source, name, given.modes[name], old, new)
        with writer.store.change() as manifest:
            for name, partitions in pairs.items():
                _accept(manifest.modes[name], given.modes[name], partitions)
    except BaseException:
        with contextlib.suppress(OSError):  # the next writer removes what is left
            _forget(writer, {name: [new for _, new in found] for name, found in pairs.items()})
        raise


def drop_partition(writer: Writer, mode_name: str, session: str | None, index: int) -> int:
    """Remove a partition and return how many rows it had.

    Raises:
        DatasetError: There is no such partition, or there are several.
        OSError: The manifest cannot be written; nothing has changed.
    """
    mode = writer.store.manifest.modes[mode_name]
    found = [p for p in mode.partitions if p.index == index and session in (None, p.session)]
    if len(found) != 1:
        there = ", ".join(f"{p.index} of {p.session!r}" for p in mode.partitions) or "none"
        what = "several partitions" if found else "no partition"
        raise DatasetError(
            f"Mode {mode_name!r} has {what} {index}"
            f"{'' if session is None else f' of session {session!r}'}. There are: {there}."
        )
    with writer.store.change() as manifest:
        mode = manifest.modes[mode_name]
        del mode.partitions[mode.place(found[0])]
        mode.dropped.append(found[0])
        if found[0].counted:
            mode.forget_statistics()
    writer.store.moved = True
    _forget(writer, {mode_name: [found[0]]})
    return found[0].rows


def _reserve(writer: Writer, given: Manifest) -> dict[str, Pairs]:
    """List the partitions to come as dropped, so that their names are taken."""
    pairs: dict[str, Pairs] = {}
    with writer.store.change() as manifest:
        for name, other in given.modes.items():
            mode, found = manifest.modes[name], pairs.setdefault(name, [])
            for old in other.partitions:
                if old.rows:
                    new = writer.new_partition(name, mode)
                    new.rows = old.rows
                    mode.dropped.append(new)
                    found.append((old, new))
    return pairs


def _copy_files(
    target: Path, source: Path, mode_name: str, mode: Mode, old: Partition, new: Partition
) -> None:
    for name, field in mode.fields.items():
        path = source / old.file_name(mode_name, name)
        offset = inspect(path, old.offsets.get(name), field.nbytes).data_offset
        place = target / new.file_name(mode_name, name)
        new.offsets[name], crc = copy(path, offset, place, new.identity(mode_name, field), old.rows)
        new.checksums[name] = crc
        if old.checksums and crc != old.checksums[name]:
            wanted = old.checksums[name]
            raise DatasetError(
                f"{path} was changed: its rows have checksum {crc:08x}, not {wanted:08x}. "
                "Nothing was merged."
            )


def _accept(mode: Mode, other: Mode, pairs: Pairs) -> None:
    """Make copied partitions part of the mode, with the statistics that the other has."""
    arrived = {new.key: new for _, new in pairs}
    mode.dropped = [partition for partition in mode.dropped if partition.key not in arrived]
    known = all(old.counted for old, _ in pairs)
    for new in arrived.values():
        new.sealed, new.counted = True, known
        mode.partitions.append(new)
    if known:
        mode.statistics = coverage.merged(mode.statistics, other.statistics)


def _forget(writer: Writer, partitions: Mapping[str, list[Partition]]) -> None:
    """Remove the files of dropped partitions, and then their entries."""
    for name, dropped in partitions.items():
        mode = writer.store.manifest.modes[name]
        for partition in dropped:
            remove_files(writer.store.directory, name, mode, partition)
    with writer.store.change() as manifest:
        for name, dropped in partitions.items():
            keys = {partition.key for partition in dropped}
            mode = manifest.modes[name]
            mode.dropped = [p for p in mode.dropped if p.key not in keys]
