"""Partitions that several processes write in turn: the side of the process with the manifest.

Of all rows they write, row r comes from process ``r % count``. Partitions are begun for all of them
together, as a group in which each has a stripe of the same consecutive rows. Every process commits
the rows of its own files and reports them; the dataset consists of the rows before the first
missing one. `physx_core.dataset.write.stripe_writer` is the other side.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Protocol

from physx_core import files
from physx_core.dataset.read.mode_statistics import count_sealed
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.read.virtual_index import write_index
from physx_core.dataset.repair import recovery
from physx_core.dataset.store.definitions import compare_fields
from physx_core.dataset.store.manifest import (
    Manifest,
    Mode,
    Partition,
    rows_of_stripe,
    whole_stripes,
)
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.partition.file import PartitionFile
from physx_core.dataset.store.partition.format import Stripe
from physx_core.dataset.store.sealing import remove_files, seal
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.statistics import RunningStatistics

PROOF = "dataset.clients"
"""File with a random string, by which other processes prove that they see the same folder."""


@dataclass
class _Group:
    """Partitions that were begun together.

    Attributes:
        first_row: Number of the group's first row in the mode.
        partitions: Their entries in the manifest, in the order of the stripes.
        sealed: The partitions that their writers have sealed, by the place of the stripe.
    """

    first_row: int
    partitions: list[Partition]
    sealed: dict[int, Partition] = field(default_factory=dict)


class Beginning(Protocol):
    """Begins partitions; implemented by the dataset's writer.

    Attributes:
        store: The manifest.
        session: Session that writes.
        reader: Reads what is written.
    """

    store: ManifestStore
    session: str
    reader: Reader

    def capacity(self, mode: Mode) -> int:
        """Return the number of rows of a mode that fit into a partition."""

    def new_partition(self, mode_name: str, mode: Mode) -> Partition:
        """Return a partition with the first number whose files do not exist yet."""

    def create_file(self, entry: Partition, field: Field, capacity: int) -> PartitionFile:
        """Create a file of a new partition under its temporary name."""


class Stripes:
    """The partitions of one mode that other processes write, one stripe each.

    Attributes:
        count: Number of processes.
        mode_name: Name of the mode.
        session: Session that the partitions are named after.
        directory: The dataset's folder.
        proof: Content of the file `PROOF` in that folder.
        capacity: Number of rows that fit into a partition; 0 before `define`.
        begun: Number of groups begun so far.
    """

    def __init__(self, writer: Beginning, mode_name: str, count: int) -> None:
        self.count = count
        self.mode_name = mode_name
        self.session = writer.session
        self.directory = writer.store.directory
        self.proof = secrets.token_hex(16)
        self.capacity = self.begun = 0
        self._writer, self._store = writer, writer.store
        self._groups: dict[int, _Group] = {}  # not yet sealed according to the manifest
        self._written = [0] * count
        self._fields: list[Field] = []
        with files.storing(f"Rows in {self.directory}"):
            files.replace(self.directory / PROOF, self.proof.encode())

    @property
    def fields(self) -> list[Field]:
        """The fields of the rows; empty before `define`."""
        return self._fields

    def define(self, fields: Iterable[Field]) -> None:
        """Define the fields of the rows, with their shapes.

        Raises:
            FieldsMismatchError: If the mode already has different fields.
        """
        given = {field.name: field for field in fields}
        with (
            files.storing(f"The fields of mode {self.mode_name!r}"),
            self._store.change() as manifest,
        ):
            mode = manifest.modes.setdefault(self.mode_name, Mode(given))
            compare_fields(f'Mode "{self.mode_name}" of the dataset', mode.fields, given)
            mode.fields = {name: given[name] for name in mode.fields}
        self._fields = list(mode.fields.values())
        self.capacity = self._writer.capacity(mode)

    def begin(self) -> None:
        """Begin a group: create and list a partition for each stripe."""
        created: list[PartitionFile] = []
        with files.storing(f"New partitions of mode {self.mode_name!r}"):
            try:
                group = self._create(created)
            except BaseException:
                for file in created:
                    file.discard()
                raise
            for file in created:
                file.close()
        self._groups[self.begun] = group
        self.begun += 1

    def entries(self, place: int) -> dict[int, Partition]:
        """Return the partitions of a stripe that are not sealed yet, by number."""
        return {
            number: group.partitions[place]
            for number, group in self._groups.items()
            if place not in group.sealed
        }

    def note(self, place: int, rows: int) -> None:
        """Record the number of rows of a stripe, in all its partitions together."""
        self._written[place] = rows

    @property
    def whole(self) -> int:
        """Number of rows before the first missing one."""
        return whole_stripes(self._written)

    def commit(self, total: int) -> None:
        """Make the first `total` rows readable in this process; none of them may be missing."""
        for number, group in self._groups.items():
            for place, partition in enumerate(group.partitions):
                rows = rows_of_stripe(total, place, self.count) - number * self.capacity
                partition.rows = min(max(0, rows), self.capacity)
        full = [
            group
            for group in self._groups.values()
            if len(group.sealed) == self.count
            and all(partition.rows == self.capacity for partition in group.partitions)
        ]
        if full:
            with files.storing(f"Sealed partitions of mode {self.mode_name!r}"):
                self._list([partition for group in full for partition in group.sealed.values()])

    def accept(
        self,
        place: int,
        number: int,
        rows: int,
        checksums: dict[str, int],
        running: dict[str, RunningStatistics],
    ) -> bool:
        """Accept a partition that its writer has sealed, with checksums and statistics.

        Returns:
            Whether the partition was open and its files agree.
        """
        group = self._groups.get(number)
        if group is None or place in group.sealed:
            return False
        entry, offsets = group.partitions[place], {}
        for of in self._fields:
            found = entry.inspect(self.directory, of)
            if found.identity != entry.identity(of) or {found.rows, found.capacity} != {rows}:
                return False
            offsets[of.name] = found.data_offset
        group.sealed[place] = replace(
            entry,
            rows=rows,
            offsets=offsets,
            sealed=True,
            follows=None,
            checksums=checksums,
            running=running,
        )
        return True

    def close(self) -> None:
        """Keep all rows before the first missing one, and seal what the writers have not."""
        if not self._groups:
            return
        told, mode = self.whole, self._store.manifest.modes[self.mode_name]
        before = mode.rows - sum(p.rows for g in self._groups.values() for p in g.partitions)
        before_listed = min(self._groups) * self.capacity * self.count
        only = Manifest({self.mode_name: mode})
        recovery.count_rows(self.directory, only)
        for problem in only.problems.values():
            raise problem
        partitions, sealed = [p for g in self._groups.values() for p in g.partitions], []
        for group in self._groups.values():
            for place, partition in enumerate(group.partitions):
                done = group.sealed.get(place)
                if done is not None and done.rows == partition.rows:
                    sealed.append(done)
                elif partition.rows:
                    sealed.append(seal(self.directory, mode.fields, partition))
        empty = [partition for partition in partitions if not partition.rows]
        self._list(sealed, empty)
        for partition in empty:
            remove_files(self.directory, mode.fields, partition)
        missing = told - before_listed - (mode.rows - before)
        if missing > 0:
            raise DatasetError(
                f"{missing} rows that clients wrote to {self.directory} are missing. Was one of "
                "their machines switched off? The rows before them are intact."
            )

    def remove_proof(self) -> None:
        """Remove the `PROOF` file; nothing is written any more."""
        self._groups.clear()
        with contextlib.suppress(OSError):
            files.remove(self.directory / PROOF)

    def _create(self, created: list[PartitionFile]) -> _Group:
        with self._store.change() as manifest:
            mode = manifest.modes[self.mode_name]
            earlier = self._groups.get(self.begun - 1)
            first = mode.next_row
            if earlier is not None:
                first = max(first, earlier.first_row + self.capacity * self.count)
            group = _Group(first, [])
            for place in range(self.count):
                entry = self._writer.new_partition(self.mode_name, mode)
                entry.first_row = first + place
                entry.stripe = Stripe(place, self.count) if self.count > 1 else None
                if earlier is not None:
                    entry.follows = earlier.partitions[place].index, self.capacity
                for of in self._fields:
                    created.append(self._writer.create_file(entry, of, self.capacity))
                group.partitions.append(entry)
                mode.partitions.append(entry)
            for file in created:
                file.publish()
            files.sync_folder(self.directory)
        return group

    def _list(self, sealed: list[Partition], empty: Iterable[Partition] = ()) -> None:
        """Mark partitions as sealed in the manifest and drop empty ones."""
        with self._store.change() as manifest:
            mode = manifest.modes[self.mode_name]
            for partition in sealed:
                mode.swap(partition)
            for partition in empty:
                del mode.partitions[mode.place(partition)]
            count_sealed(self.directory, manifest, mode)
            write_index(self._writer.reader, self.session)
        keys = {partition.key for partition in sealed}
        self._groups = {
            number: group
            for number, group in self._groups.items()
            if not keys & {partition.key for partition in group.partitions}
        }
