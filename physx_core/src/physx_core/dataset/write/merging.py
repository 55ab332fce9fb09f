"""Adds whole partitions of another dataset, and removes partitions.

Either takes effect with a single change of the manifest: partitions that are being added or removed
are listed as dropped, so that after a crash the next writer removes their leftover files.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from physx_core import files
from physx_core.dataset.read.mode_statistics import add_counted
from physx_core.dataset.store import statistics_file
from physx_core.dataset.store.episode_table import EPISODES, has_table
from physx_core.dataset.store.manifest import Manifest, Mode, Partition
from physx_core.dataset.store.partition.file import copy
from physx_core.dataset.write.compacting import forget, reserve, rows_in, write
from physx_core.dataset.write.merged_records import MergedRecords
from physx_core.dataset.write.writer import Writer
from physx_core.errors import DatasetError
from physx_core.fields import Field

Pairs = list[tuple[Partition, Partition]]


def add_partitions(writer: Writer, source: Path, given: Manifest) -> None:
    """Add either all partitions of another dataset or none.

    Args:
        writer: Writes the dataset; the modes that receive rows must have the other's fields and no
            open partition.
        source: Folder of the other dataset.
        given: Manifest of the other dataset.
    """
    statistics_file.load(source, given)
    records = MergedRecords(writer.recorder, source, given)
    pairs = _reserve(writer, given)
    table = _reserve_table(writer, records)
    try:
        for name, partitions in pairs.items():
            for old, new in partitions:
                _copy_files(writer.store.directory, source, given.modes[name].files, old, new)
        sealed = list(write(writer, table, rows_in(records.rows)))
        files.sync_folder(writer.store.directory)
        with writer.store.change() as manifest:
            statistics_file.load(writer.store.directory, manifest)
            if given.info:
                manifest.info["merged"] = [*manifest.info.get("merged", []), given.info]
            for name, partitions in pairs.items():
                _accept(manifest, manifest.modes[name], given.modes[name], partitions)
            for entry in sealed:
                mode = manifest.modes[EPISODES]
                mode.dropped = [p for p in mode.dropped if p.key != entry.key]
                mode.add(entry)
    except BaseException:
        with contextlib.suppress(OSError):  # the next writer removes what is left
            found = {name: [new for _, new in found] for name, found in pairs.items()}
            forget(writer, {**found, **({EPISODES: table} if table else {})})
        raise
    records.take_effect()


def drop_partition(writer: Writer, mode_name: str, session: str | None, index: int) -> int:
    """Seal all partitions of a mode, remove one, and return its number of rows."""
    _find(writer, mode_name, session, index)  # an invalid call changes nothing
    writer.finish(mode_name)
    found = _find(writer, mode_name, session, index)
    with writer.store.change() as manifest:
        mode = manifest.modes[mode_name]
        mode.partitions.remove(found)
        mode.dropped.append(found)
        mode.removed[found.session] = max(found.index, mode.removed.get(found.session, -1))
        if found.counted:
            mode.forget_statistics()
    writer.store.manifest.renumber()
    forget(writer, {mode_name: [found]})
    writer.recorder.load()
    return found.rows


def _find(writer: Writer, mode_name: str, session: str | None, index: int) -> Partition:
    mode = writer.store.manifest.modes[mode_name]
    found = [p for p in mode.partitions if p.index == index and session in (None, p.session)]
    if len(found) == 1:
        return found[0]
    there = ", ".join(f"{p.index} of {p.session!r}" for p in mode.partitions) or "none"
    what = "several partitions" if found else "no partition"
    raise DatasetError(
        f"Mode {mode_name!r} has {what} {index}"
        f"{'' if session is None else f' of session {session!r}'}. Partitions: {there}."
    )


def _reserve(writer: Writer, given: Manifest) -> dict[str, Pairs]:
    """List the partitions to add as dropped, to reserve their names."""
    pairs: dict[str, Pairs] = {}
    with writer.store.change() as manifest:
        for name, other in given.modes.items():
            if name == EPISODES and has_table(given):
                continue  # its records are written anew
            mode, found = manifest.modes[name], pairs.setdefault(name, [])
            first = mode.next_row
            for old in (partition for partition in other.partitions if partition.rows):
                new = writer.new_partition(name, mode)
                new.rows, new.sizes = old.rows, old.sizes
                new.first_row = first + old.first_row
                mode.dropped.append(new)
                found.append((old, new))
    return pairs


def _reserve_table(writer: Writer, records: MergedRecords) -> list[Partition]:
    """Reserve partitions for the further records, if there are any."""
    if not records.count:
        return []
    with writer.store.change() as manifest:
        return reserve(writer, manifest.modes, EPISODES, records.rows)


def _copy_files(
    target: Path, source: Path, fields: Mapping[str, Field], old: Partition, new: Partition
) -> None:
    for name, field in fields.items():
        path, offset = old.path(source, name), old.inspect(source, field).data_offset
        place, identity = new.path(target, name), new.identity(field)
        new.offsets[name], crc = copy(path, offset, place, identity, old.rows_of(field))
        new.checksums[name] = crc
        if old.checksums and crc != old.checksums[name]:
            wanted = old.checksums[name]
            raise DatasetError(
                f"{path} was changed: its rows have checksum {crc:08x}, not {wanted:08x}. "
                "Nothing was merged."
            )


def _accept(manifest: Manifest, mode: Mode, other: Mode, pairs: Pairs) -> None:
    """Make copied partitions part of the mode, with the other's statistics if complete."""
    arrived = {new.key: new for _, new in pairs}
    mode.dropped = [partition for partition in mode.dropped if partition.key not in arrived]
    known = all(old.counted for old, _ in pairs)
    for new in arrived.values():
        new.sealed, new.counted = True, known
        mode.add(new)
    if known:
        add_counted(manifest, mode, other.statistics or {})
