"""Removes rows that no episode has, and puts the others in order of campaign and number.

The rows are copied to new partitions, and the records that count to a new table. These take the
place of the old ones with a single change of the manifest. Before it, the new ones are listed as
dropped, after it the old ones, so that after a crash the next writer removes what is left of
either. The first partitions of a mode stay if their rows are the first ones in order.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from physx_core import files
from physx_core.dataset.read.access.columns import ColumnCache
from physx_core.dataset.read.order.order import Order
from physx_core.dataset.read.ordered_statistics import store_in_order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.views import ModeView
from physx_core.dataset.read.virtual_index import write_index
from physx_core.dataset.repair.report import find_problem
from physx_core.dataset.store.episode_table import EPISODES
from physx_core.dataset.store.manifest import Manifest, Mode, Partition, Partitions
from physx_core.dataset.store.partition.segment import rows_per_block
from physx_core.dataset.store.sealing import remove_files, seal
from physx_core.dataset.write.compacted_records import compacted_records
from physx_core.dataset.write.writer import Writer
from physx_core.errors import DatasetError
from physx_core.fields import ENDS, free_axes
from physx_core.packing import join, lengths
from physx_core.typing import Array, Batch, Index

_FREE_ROWS = 256
PartitionsByMode = dict[str, list[Partition]]
ReadRows = Callable[[str, int, int], Array]


def compact(writer: Writer, modes: Sequence[str]) -> int:
    """Compact modes with episodes: see `Dataset.compact`.

    Args:
        writer: Writes the dataset.
        modes: The modes; those without records are left as they are.

    Returns:
        How many bytes of disk space were freed.
    """
    store = writer.store
    reader = writer.reader
    orders = {name: order for name in modes if (order := reader.order(name)) is not None}
    if not orders:
        return 0
    for name in (*orders, EPISODES):
        writer.finish(name)
    kept = {name: _kept(store.manifest.modes[name], order) for name, order in orders.items()}
    old = {name: store.manifest.modes[name].partitions[count:] for name, count in kept.items()}
    is_done = not any(partition.rows for each in old.values() for partition in each)
    if is_done and _is_compact(writer, reader, orders):
        return 0
    old[EPISODES] = list(store.manifest.modes[EPISODES].partitions)
    _check(store.directory, store.manifest, old)
    before = _size(store.directory)
    _replace(writer, reader, orders, old)
    write_index(reader, writer.session)
    store_in_order(reader)
    return before - _size(store.directory)


def _size(directory: Path) -> int:
    """Return how much disk space the files of a folder take, in bytes."""
    return sum(path.stat().st_blocks for path in directory.iterdir() if path.is_file()) * 512


def _kept(mode: Mode, order: Order) -> int:
    """Return how many of the first partitions hold the first rows, in order, and no others."""
    first, rows = order.places
    in_place = int(rows[0]) if len(rows) and first[0] == 0 else 0
    count, kept = 0, 0
    for partition in mode.partitions:
        kept += partition.rows
        if kept > in_place:
            break
        count += 1
    return count


def _is_compact(writer: Writer, reader: Reader, orders: Mapping[str, Order]) -> bool:
    """Return whether all records count, if all rows do and are in order."""
    modes = writer.store.manifest.modes
    own = {name: modes[name].partitions for name in orders}
    return len(compacted_records(writer, reader, orders, own)["rows"]) == modes[EPISODES].rows


def _check(directory: Path, manifest: Manifest, replaced: PartitionsByMode) -> None:
    """Check what is to be copied: a copy of damaged rows would look sound."""
    for name, partitions in replaced.items():
        for partition in partitions:
            for field in manifest.modes[name].files.values():
                if (problem := find_problem(directory, partition, field)) is not None:
                    raise DatasetError(f"{problem} Nothing was compacted.")


def _replace(
    writer: Writer, reader: Reader, orders: Mapping[str, Order], old: PartitionsByMode
) -> None:
    """Write the new partitions, and let them take the place of the old ones."""
    store, new, sealed = writer.store, {}, {}
    with store.change() as manifest:
        stay = {name: _without(manifest.modes[name].partitions, old[name]) for name in orders}
        begin = {name: sum(partition.rows for partition in stay[name]) for name in orders}
        for name, order in orders.items():
            sizes = _sizes(reader, name, order, begin[name])
            rows = order.rows - begin[name]
            new[name] = _reserve(writer, manifest.modes, name, rows, sizes)
        own = {name: [*stay[name], *new[name]] for name in orders}
        table = compacted_records(writer, reader, orders, own)
        new[EPISODES] = reserve(writer, manifest.modes, EPISODES, table)
    try:
        for name in orders:
            read = _rows_of(reader, name, begin[name])
            sealed[name] = list(write(writer, new[name], read))
        sealed[EPISODES] = list(write(writer, new[EPISODES], rows_in(table)))
        files.sync_folder(store.directory)
        with store.change() as manifest:
            for name, partitions in sealed.items():
                _exchange(manifest.modes[name], old[name], partitions)
    except BaseException:
        with contextlib.suppress(OSError):  # the next writer removes what is left
            forget(writer, new)
        raise
    store.manifest.renumber()
    forget(writer, old)
    writer.recorder.load()


def _sizes(reader: Reader, mode: str, order: Order, begin: int) -> dict[str, Index]:
    """Return how many entries rows have, in order from row `begin` on, by free axis."""
    if not reader.mode(mode).axes:
        return {}
    return reader.sizes(mode, order.stored(np.arange(begin, order.rows)))


def reserve(writer: Writer, modes: Mapping[str, Mode], name: str, table: Batch) -> list[Partition]:
    """Return partitions for rows of a mode, which the manifest lists as dropped until they count.

    Args:
        writer: Writer of the dataset.
        modes: The modes, in a change of the manifest.
        name: Name of the mode.
        table: The rows, by field.
    """
    axes = free_axes(modes[name].fields.values())
    sizes = {axis: lengths(table[names[0]]) for axis, names in axes.items()}
    return _reserve(writer, modes, name, len(next(iter(table.values()))), sizes)


def _reserve(
    writer: Writer, modes: Mapping[str, Mode], name: str, rows: int, sizes: Mapping[str, Index]
) -> list[Partition]:
    """List partitions for rows as dropped, to reserve their names and addresses."""
    mode, found, start = modes[name], [], 0
    ends = {axis: np.append(0, np.cumsum(each)) for axis, each in sizes.items()}
    least = {
        axis: min(writer.capacity_of(f) for f in mode.fields.values() if f.free_axis == axis)
        for axis in ends
    }
    while start < rows:
        entry, stop = writer.new_partition(name, mode), min(start + writer.capacity(mode), rows)
        for axis, end in ends.items():
            last = int(end.searchsorted(end[start] + least[axis], "right")) - 1
            stop = min(stop, max(last, start + 1))
        entry.rows = stop - start
        entry.sizes = {axis: int(end[stop] - end[start]) for axis, end in ends.items()}
        mode.dropped.append(entry)
        found.append(entry)
        start = stop
    return found


def _rows_of(reader: Reader, mode: str, begin: int) -> ReadRows:
    """Return what reads rows of a mode, counted from `begin`, in order."""
    view = ModeView(ColumnCache(reader), mode)
    return lambda name, start, stop: view[name][begin + start : begin + stop]


def rows_in(table: Batch) -> ReadRows:
    """Return what reads rows of a table."""
    return lambda name, start, stop: table[name][start:stop]


def write(writer: Writer, partitions: Sequence[Partition], read: ReadRows) -> Iterator[Partition]:
    """Write rows to the files of reserved partitions, and yield these, sealed."""
    done, directory = 0, writer.store.directory
    for entry in partitions:
        mode = writer.store.manifest.modes[entry.mode]
        fields, free = mode.files, free_axes(mode.fields.values())
        first_of = {axis + ENDS: names[0] for axis, names in free.items()}
        for name, field in fields.items():
            file = writer.create_file(entry, field, entry.rows_of(field))
            step, entries = rows_per_block(field.nbytes), 0
            if field.free_axis or name in first_of:
                step = min(step, _FREE_ROWS)
            try:
                for start in range(0, entry.rows, step):
                    stop = min(start + step, entry.rows)
                    rows = read(first_of.get(name, name), done + start, done + stop)
                    if name in first_of:
                        block = entries + np.cumsum(lengths(rows))
                        entries = int(block[-1])
                        file.append(start, block.astype("<u8"), stop, durable=True)
                    elif field.free_axis:
                        block, _ = join(field, rows.tolist())
                        file.append(entries, block, entries + len(block), durable=True)
                        entries += len(block)
                    else:
                        file.append(start, rows, stop, durable=True)
                file.sync()
                file.publish()
            finally:
                file.close()
        done += entry.rows
        yield seal(directory, fields, entry)


def _exchange(mode: Mode, old: Sequence[Partition], new: Sequence[Partition]) -> None:
    """Let new partitions of a mode take the place of the old ones."""
    mode.forget_statistics()
    mode.partitions = Partitions([*_without(mode.partitions, old), *new])
    mode.dropped = [*_without(mode.dropped, new), *old]
    for each in old:
        mode.removed[each.session] = max(each.index, mode.removed.get(each.session, -1))


def _without(partitions: Sequence[Partition], others: Sequence[Partition]) -> list[Partition]:
    keys = {partition.key for partition in others}
    return [partition for partition in partitions if partition.key not in keys]


def forget(writer: Writer, partitions: Mapping[str, list[Partition]]) -> None:
    """Remove the files of dropped partitions, then their entries."""
    for name, dropped in partitions.items():
        mode = writer.store.manifest.modes[name]
        for partition in dropped:
            remove_files(writer.store.directory, mode.files, partition)
    with writer.store.change() as manifest:
        for name, dropped in partitions.items():
            keys = {partition.key for partition in dropped}
            mode = manifest.modes[name]
            mode.dropped = [p for p in mode.dropped if p.key not in keys]
