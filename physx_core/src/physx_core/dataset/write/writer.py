"""Writes rows to partitions; they begin and end at the same rows in all fields of a mode."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from physx_core import files
from physx_core.dataset.read.mode_statistics import compute_statistics, count_sealed
from physx_core.dataset.read.ordered_statistics import store_in_order
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.virtual_index import write_index
from physx_core.dataset.repair import recovery
from physx_core.dataset.store import locks, manifest_file
from physx_core.dataset.store.manifest import Mode, Partition
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.partition.file import PartitionFile
from physx_core.dataset.store.sealing import remove_files, seal
from physx_core.dataset.store.syncing import Syncer, sync_marked
from physx_core.dataset.write.delegation import Delegation
from physx_core.dataset.write.recording import Recorder
from physx_core.dataset.write.updating import update_rows
from physx_core.errors import DatasetError, UsageError
from physx_core.fields import ENDS, Field
from physx_core.processes import Helper
from physx_core.typing import Array, Batch, Index

_HEADER = 2**14
_COMMITTED = attrgetter("committed")
_SPARSE = 2**40
"""Bytes of entries for which a file that another process writes has space; it takes none."""


class OpenPartition:
    """The files of the partition of a mode that is being written.

    Attributes:
        partition: Its entry in the manifest.
        capacity: Number of rows that fit in.
        axes: Number of entries that fit in, by free axis.
        files: The files by field.
    """

    def __init__(
        self,
        partition: Partition,
        capacity: int,
        parts: dict[str, PartitionFile],
        syncer: Syncer | None,
    ) -> None:
        self.partition = partition
        self.capacity = capacity
        self.files = parts
        self.axes: dict[str, int] = {}
        for file in parts.values():
            if axis := file.identity.field.free_axis:
                self.axes[axis] = min(file.capacity, self.axes.get(axis, file.capacity))
        self._ends = {axis + ENDS: axis for axis in self.axes}
        partition.sizes = dict.fromkeys(self.axes, 0)
        self._syncer = syncer

    @property
    def free(self) -> int:
        """Number of rows that still fit in."""
        return self.capacity - self.partition.rows

    @property
    def is_full(self) -> bool:
        """Whether nothing more fits into any of its files."""
        return not self.free and self.axes == self.partition.sizes

    def fitting(self, rows: Batch, start: int, count: int) -> int:
        """Return how many of the rows `start` to `start + count` of a block still fit in."""
        found = min(count, self.free)
        for axis, capacity in self.axes.items():
            ends = rows[axis + ENDS]
            begin, _ = _entries(rows, axis, start, start)
            most = begin + capacity - self.partition.sizes[axis]
            found = int(ends[start : start + found].searchsorted(np.uint64(most), "right"))
        return found

    def append(self, rows: Batch, start: int, count: int) -> None:
        """Write and commit all rows `start` to `start + count` of a block, or none of them."""
        if self.axes:
            self._append_free(rows, start, count)
            return
        parts, durable = self.files.values(), self._syncer is None
        first = self.partition.rows
        last = first + count
        for file in parts:
            if file.room < last:
                file.reserve(last)
        before = tuple(map(_COMMITTED, parts))
        try:
            for name, file in self.files.items():
                file.append(first, rows[name][start : start + count], last, durable=durable)
            if durable:
                for file in parts:
                    file.sync()
            self.partition.rows = last
        except BaseException:  # also an interrupt: the next rows go to the same offsets
            self.partition.rows = first
            self._withdraw(before)
            raise
        if self._syncer is not None:
            self._syncer.note(self)

    def _append_free(self, rows: Batch, start: int, count: int) -> None:
        """Do the same with rows that have free axes."""
        parts, durable, known = self.files.values(), self._syncer is None, self.partition
        first, before_sizes = known.rows, known.sizes
        pieces, sizes = self._free_pieces(rows, start, count)
        for file, _, _, end in pieces:
            if file.room < end:
                file.reserve(end)
        before = tuple(map(_COMMITTED, parts))
        try:
            for file, block, begin, end in pieces:
                file.append(begin, block, end, durable=durable)
            if durable:
                for file in parts:
                    file.sync()
            known.rows, known.sizes = first + count, sizes
        except BaseException:
            known.rows, known.sizes = first, before_sizes
            self._withdraw(before)
            raise
        if self._syncer is not None:
            self._syncer.note(self)

    def _withdraw(self, commits: tuple[tuple[int, int, int], ...]) -> None:
        """Return to earlier commits of the files."""
        for file, commit in zip(self.files.values(), commits, strict=True):
            file.withdraw(commit)

    def _free_pieces(
        self, rows: Batch, start: int, count: int
    ) -> tuple[list[tuple[PartitionFile, Array, int, int]], dict[str, int]]:
        """Return what of a block goes to which rows of each file, and the sizes after that."""
        first, stop, pieces, sizes = self.partition.rows, start + count, [], {}
        for name, file in self.files.items():
            axis, block = file.identity.field.free_axis, rows[name]
            if axis:
                begin, end = _entries(rows, axis, start, stop)
                base = self.partition.sizes[axis]
                sizes[axis] = base + end - begin
                pieces.append((file, block[begin:end], base, sizes[axis]))
                continue
            block = block[start:stop]
            if name in self._ends:
                base, (begin, _) = (
                    self.partition.sizes[self._ends[name]],
                    _entries(rows, self._ends[name], start, stop),
                )
                block = (block.astype(np.int64) + (base - begin)).astype("<u8")
            pieces.append((file, block, first, first + count))
        return pieces, sizes

    def settle(self, names: Iterable[str], last: int) -> None:
        """Prepare some fields for an update of rows up to `last`."""
        for name in names:
            file = self.files[name]
            if file.identity.field.free_axis or file.is_checked(last):
                file.settle()

    def close(self) -> None:
        """Close the files; the syncer syncs them once more."""
        for file in self.files.values():
            file.close()
            if self._syncer is not None:
                self._syncer.note_path(file.path)


class Writer:
    """Appends checked rows to the modes of a dataset.

    Attributes:
        store: The manifest, kept up to date in memory and on disk.
        session: Name of the session that writes.
        reader: Reads what is written.
        recorder: Writes the table of episodes.
    """

    def __init__(
        self,
        store: ManifestStore,
        session: str,
        max_file_size: float,
        durable: bool,
        lock: files.FileLock,
        helper: Callable[[str], Helper[Any]] = Helper,
    ) -> None:
        """Start without an open partition.

        Args:
            store: The manifest.
            session: Name of the session that writes.
            max_file_size: Size in GB at which a partition is full.
            durable: Whether each commit waits for the disk; otherwise files are synced about once
                a second.
            lock: The dataset's lock, which `close` releases.
            helper: Makes what works beside the caller, given a name.
        """
        self.store = store
        self.session = session
        self._lock = lock
        self._directory = store.directory
        self._max_nbytes = int(max_file_size * 1e9) - _HEADER
        self._syncer = None if durable else Syncer(helper("physx-sync"))
        self._digester: Helper[None] = helper("physx-digest")
        self.reader = Reader(store.directory, store.manifest)
        self._open: dict[str, OpenPartition] = {}
        self._filled: dict[str, Partition] = {}
        self._sealed: list[Partition] = []
        self._sealer: Helper[Partition] = helper("physx-seal")
        self._delegations: dict[str, Delegation] = {}
        self.recorder = Recorder(self, self.reader)
        self._recorded = self.recorder.recorded

    @property
    def is_own(self) -> bool:
        """Whether this process opened it, rather than having been forked from one that did."""
        return self._lock.is_own

    def delegate(self, mode_name: str) -> Delegation:
        """Let other processes write a mode's rows from now on: see `Dataset.delegate`."""
        self.finish(mode_name)
        found = self._delegations[mode_name] = Delegation(self, mode_name)
        return found

    def delegation(self, mode_name: str) -> Delegation | None:
        """Return through what other processes write the rows of a mode; None if none do."""
        found = self._delegations.get(mode_name)
        return None if found is None or found.is_closed else found

    def check_alone(self, mode_names: Iterable[str]) -> None:
        """Refuse to change rows of modes that other processes write."""
        for name in mode_names:
            if self.delegation(name) is not None:
                raise UsageError(
                    f"Other processes write the rows of mode {name!r}: nothing else may change "
                    "them until its delegation is closed."
                )

    def append(self, mode_name: str, rows: Batch, count: int) -> None:
        """Store and commit rows.

        Args:
            mode_name: Name of a mode whose fields all have shapes.
            rows: Field name to checked rows.
            count: Number of rows.
        """
        done, syncer = 0, self._syncer
        if self._delegations:
            self.check_alone([mode_name])
        if self._recorded and count and mode_name in self._recorded:
            self.recorder.begin_stream(mode_name)
        try:
            if self.store.failure is not None or (syncer is not None and syncer.error is not None):
                self._check()
            if self._sealer.pending or self._sealed:
                self._collect(wait=False)
            while done < count:
                partition = self._open.get(mode_name)
                free = 0 if partition is None else partition.free
                if partition is not None and partition.axes:
                    free = partition.fitting(rows, done, count - done)
                if partition is None or not free:
                    if partition is not None:
                        self._retire(mode_name)
                    partition = self._open[mode_name] = self._begin(mode_name, rows, done)
                    free = partition.fitting(rows, done, count - done)
                part = min(free, count - done)
                partition.append(rows, done, part)
                done += part
        except OSError as error:
            self._note(error)
            what = f"{count - done} of {count} rows of mode {mode_name!r}"
            safe = f"The {self.store.manifest.modes[mode_name].rows} samples before them"
            raise files.storage_error(what, error, safe) from error

    def update(self, mode_name: str, index: Index, rows: Batch) -> None:
        """Overwrite rows in place.

        Args:
            mode_name: Name of the mode.
            index: Numbers of the rows, all in range.
            rows: Field name to new rows, checked.
        """
        self.check_alone([mode_name])
        self.wait()
        with self.store.syncing():
            self._check()
            opened = self._open.get(mode_name)
            mode = self.store.manifest.modes[mode_name]
            bounds = {axis: self.reader.bounds(mode_name, axis) for axis in mode.axes}
            updated = update_rows(self.store, mode_name, index, rows, opened, bounds)
            for path in updated:
                self.note_path(path)

    def refresh(self) -> None:
        """Load what other writers have committed."""
        if self.store.shared:
            with files.storing("Rows of other writers"), locks.lock_manifest(self._directory):
                self.store.reload(recovery.load(self._directory))

    def finish(self, mode_name: str) -> None:
        """Seal the open partition of a mode, if any, and wait until all are sealed."""
        self.check_alone([mode_name])
        if mode_name in self._open:
            self._retire(mode_name)
        self.wait()

    def sync(self, mode_name: str) -> None:
        """Wait until all rows of a mode are on the disk."""
        self.wait()
        with self.store.syncing():
            opened = self._open.get(mode_name)
            for file in opened.files.values() if opened is not None else ():
                sync_marked(file)

    def note_path(self, path: Path) -> None:
        """Have a file on the disk soon; at once if each commit waits for the disk."""
        if self._syncer is not None:
            self._syncer.note_path(path)
        else:
            files.sync_file(path)

    def wait(self) -> None:
        """Wait until all full partitions are sealed."""
        self._collect(wait=True)

    def close(self) -> None:
        """Seal open partitions, write manifest and index, and release the lock.

        If the disk is full or has failed, the last partitions remain unsealed: all their rows can
        be read, and the next writer seals them.
        """
        try:
            with files.storing("The dataset's last partition"):
                self._check()
                for mode_name in list(self._open):
                    self._retire(mode_name)
                for delegation in self._delegations.values():
                    delegation.close()
                self._collect(wait=True)
                self._complete()
        except DatasetError as error:
            cause = error.__cause__
            if not (isinstance(cause, OSError) and cause.errno in files.FULL):
                raise
        finally:
            for delegation in self._delegations.values():
                delegation.remove_proof()
            self._sealer.close()
            self._digester.close()
            for opened in self._open.values():
                opened.close()
            self._open.clear()
            try:
                if self._syncer is not None:
                    with files.storing("The last rows"):
                        self._syncer.close()
            finally:
                self._lock.close()

    def _check(self) -> None:
        """Refuse to continue after a failed sync."""
        if self._syncer is not None:
            self._syncer.check()
        if self.store.failure is not None:
            raise self.store.failure

    def _note(self, error: OSError) -> None:
        """Remember that a sync has failed."""
        if self.store.failure is None and isinstance(error, files.SyncError):
            self.store.failure = error

    def _retire(self, mode_name: str) -> None:
        """Close the open partition of a mode and seal it in the background."""
        opened = self._open.pop(mode_name)
        entry = opened.partition
        entry.writing = opened.is_full  # the files of a full one do not change
        opened.close()
        self._filled[mode_name] = entry
        fields = self.store.manifest.modes[mode_name].files
        self._sealer.give(partial(_seal, self._directory, fields, replace(entry)))

    def _collect(self, *, wait: bool) -> None:
        """Record in the manifest which partitions have been sealed."""
        while self._sealer.pending and (wait or self._sealer.is_ready):
            try:
                self._sealed.append(self._sealer.take())
            except OSError as error:
                self._note(error)
                if wait or error.errno not in files.FULL:
                    raise
        if not self._sealed:
            return
        with self.store.turn() as manifest:
            for entry in self._sealed:
                mode = manifest.modes[entry.mode]
                if entry.rows < mode.partitions[mode.place(entry)].rows:
                    manifest.renumber()  # some are lost
            listed: list[Partition] = []
            for entry in self._sealed:
                if entry.rows:
                    listed.append(self._counted(entry, listed))
            self.store.put(listed)
        empty = [entry for entry in self._sealed if not entry.rows]
        self._sealed.clear()
        if empty or self.store.has_grown:
            self._fold(empty)

    def _counted(self, entry: Partition, listed: Sequence[Partition]) -> Partition:
        """Return a sealed partition with its rows in the mode's statistics if it has its own.

        Those before it must be counted, perhaps as they are about to be `listed`; partitions of
        processes that write at the same time are counted as they come.
        """
        mode = self.store.manifest.modes[entry.mode]
        place = 0 if self.store.shared else mode.place(entry)
        before = mode.partitions[place - 1] if place else None
        counted = {(each.mode, each.key) for each in listed if each.counted}
        if before is not None and not (before.counted or (entry.mode, before.key) in counted):
            return entry
        found = count_sealed(self._directory, self.store.manifest, mode, [entry])
        return found[0] if found else entry

    def _fold(self, empty: Sequence[Partition] = ()) -> None:
        """Write the manifest as a whole, without partitions that have no rows, and the index."""
        with self.store.change() as manifest:
            for entry in empty:
                manifest.modes[entry.mode].partitions.remove(entry)
            write_index(self.reader, self.session)
        for entry in empty:
            remove_files(self._directory, self.store.manifest.modes[entry.mode].files, entry)

    def seal(self, entry: Partition, how: Callable[[Partition], Partition]) -> None:
        """Seal a partition that another process has written, in the background."""
        self._sealer.give(partial(how, replace(entry)))

    def list_sealed(self, entry: Partition) -> None:
        """List a partition as sealed that another process has sealed, before long."""
        self._sealed.append(entry)

    def begin(self, mode_name: str, first_row: int) -> Partition:
        """Begin a partition that another process writes, and return its entry."""
        opened = self._begin(mode_name, {}, 0, first_row)
        opened.close()
        return opened.partition

    def _begin(
        self, mode_name: str, rows: Batch, start: int, first_row: int | None = None
    ) -> OpenPartition:
        """Create the files of a partition, then list it; rows may be committed only after that.

        Args:
            mode_name: Name of the mode.
            rows: Rows of which one must fit in; empty if another process writes them.
            start: That one.
            first_row: Address of its first row if another process writes it.
        """
        parts: dict[str, PartitionFile] = {}
        try:
            with self.store.turn() as manifest:
                mode = manifest.modes[mode_name]
                capacity = self.capacity(mode)
                entry = self.new_partition(mode_name, mode)
                entry.writing = True
                if first_row is None:
                    entry.follows = self._find_unsealed_before(mode_name, mode)
                else:
                    entry.first_row = first_row
                least = {
                    axis: end - begin
                    for axis in (mode.axes if rows else ())
                    for begin, end in [_entries(rows, axis, start, start + 1)]
                }
                for name, field in mode.files.items():
                    most = capacity
                    if field.free_axis:
                        most = max(self.capacity_of(field), least.get(field.free_axis, 0))
                        most = most if rows else _SPARSE // max(1, field.nbytes)
                    parts[name] = self.create_file(entry, field, most)
                for part in parts.values():
                    part.publish()
                files.sync_folder(self._directory)
                self.store.put([entry])
        except BaseException:
            for part in parts.values():
                part.discard()
            raise
        return OpenPartition(entry, capacity, parts, self._syncer)

    def capacity(self, mode: Mode, entries: int = 0) -> int:
        """Return the number of rows of a mode that fit into a partition.

        Args:
            mode: The mode.
            entries: About how many entries of a free axis a row has.
        """
        known = mode.files.values()
        row_nbytes = max(1, *(f.nbytes * (entries if f.free_axis else 1) for f in known))
        return max(1, self._max_nbytes // row_nbytes)

    def capacity_of(self, field: Field) -> int:
        """Return the number of entries of a free axis that fit into a field's file."""
        return max(1, self._max_nbytes // max(1, field.nbytes))

    def create_file(self, entry: Partition, field: Field, capacity: int) -> PartitionFile:
        """Create a file of a new partition under its temporary name."""
        identity = entry.identity(field)
        file = PartitionFile.create(self._directory, identity, capacity, self._digester)
        entry.offsets[field.name] = file.data_offset
        return file

    def new_partition(self, mode_name: str, mode: Mode) -> Partition:
        """Return a partition with the first number whose files do not exist yet."""
        index = mode.next_index(self.session)
        entry = Partition(mode_name, self.session, index, mode.next_row)
        while any(entry.path(self._directory, name).exists() for name in mode.files):
            entry = replace(entry, index=entry.index + 1)
        return entry

    def _find_unsealed_before(self, mode_name: str, mode: Mode) -> tuple[int, int] | None:
        """Return number and rows of the partition before a new one if it is still unsealed."""
        before = self._filled.get(mode_name)
        if before is None:
            return None
        listed = mode.partitions.has(before.key) and not mode.partitions[mode.place(before)].sealed
        return (before.index, before.rows) if listed else None

    def _complete(self) -> None:
        """Compute what is missing: checksums of updated partitions, statistics, the index."""
        if self.store.shared:
            if self.store.manifest.has_changes:
                self._fold()
            return
        manifest = self.store.manifest
        changed = recovery.complete_checksums(self._directory, manifest)
        for name, mode in manifest.modes.items():
            if any(partition.sealed and not partition.counted for partition in mode.partitions):
                changed = True
                with contextlib.suppress(DatasetError):  # a partition is damaged: skip for now
                    compute_statistics(self.reader, name)
        if changed or manifest.has_new_statistics or manifest.has_changes:
            manifest_file.save(self._directory, manifest)
        store_in_order(self.reader)
        write_index(self.reader, self.session, wait=True)


def _entries(rows: Batch, axis: str, start: int, stop: int) -> tuple[int, int]:
    """Return where the entries of rows `start` to `stop` of a block begin and end in it."""
    ends = rows[axis + ENDS]
    return int(ends[start - 1]) if start else 0, int(ends[stop - 1]) if stop else 0


def _seal(directory: Path, fields: Mapping[str, Field], partition: Partition) -> Partition:
    return seal(directory, fields, partition) if partition.rows else partition
