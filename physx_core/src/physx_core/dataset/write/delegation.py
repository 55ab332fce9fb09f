"""Delegation: lets other processes write the rows of a mode; this one keeps the manifest.

Each has a range of addresses of its own, far longer than it will need, and one partition after
another there, so that its rows have consecutive addresses. It commits them in its files and reports
them; they count once a record in the table of episodes speaks of them. Another process never goes
on where one has ended. `physx_core.dataset.write.partition_writer` is the side of the others.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from physx_core import files
from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store.definitions import compare_fields
from physx_core.dataset.store.manifest import Mode, Partition
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.store.sealing import count_rows, measure, seal
from physx_core.dataset.write.recording import Recorder
from physx_core.errors import DatasetError
from physx_core.fields import Field
from physx_core.typing import Batch

PROOF = "dataset.clients"
"""File with a random string, by which other processes prove that they see the same folder."""
TYPICAL = 1024
"""Number of entries that a row may have on average; more only make partitions longer."""
ADDRESSES = 2**36
"""Number of addresses of a process."""


class Owner(Protocol):
    """Begins and lists partitions; implemented by the dataset's writer.

    Attributes:
        store: The manifest.
        recorder: Writes the table of episodes.
    """

    store: ManifestStore
    recorder: Recorder

    def capacity(self, mode: Mode, entries: int = 0) -> int:
        """Return the number of rows of a mode that fit into a partition: see `Writer`."""

    def begin(self, mode_name: str, first_row: int) -> Partition:
        """Begin a partition that another process writes, and return its entry."""

    def seal(self, entry: Partition, how: Callable[[Partition], Partition]) -> None:
        """Seal a partition that another process has written, in the background."""

    def list_sealed(self, entry: Partition) -> None:
        """List a partition as sealed that another process has sealed, before long."""

    def wait(self) -> None:
        """Wait until all partitions that are being sealed are listed as such."""


class Share:
    """What one process writes.

    Attributes:
        fields: The fields that have files.
        capacity: Number of rows that fit into a partition.
        first: Address of its first row.
        end: Address after the last row that it has reported.
    """

    def __init__(self, owner: Owner, mode_name: str, fields: list[Field], capacity: int) -> None:
        """Reserve addresses."""
        self.fields, self.capacity = fields, capacity
        self._owner, self._mode_name = owner, mode_name
        self.first = self.end = self._mode.next_row
        self._mode.taken = self.first + ADDRESSES
        self._begun = 0
        self._open: dict[int, Partition] = {}  # by first row

    @property
    def _mode(self) -> Mode:
        return self._owner.store.manifest.modes[self._mode_name]

    def begin(self) -> Partition:
        """Create and list the next partition."""
        first_row = self.first + self._begun * self.capacity
        with files.storing(f"A new partition of mode {self._mode_name!r}"):
            entry = self._open[first_row] = self._owner.begin(self._mode_name, first_row)
        self._begun += 1
        return entry

    def take(self, first: int, rows: int) -> None:
        """Note rows that the process reports.

        Raises:
            ValueError: If they do not follow the ones before, or lie outside its partitions.
        """
        end = first + rows
        if first != self.end or end > self.first + self._begun * self.capacity:
            raise ValueError(f"{rows} rows at the address {first} instead of {self.end}")
        self.end = end
        for first_row, entry in self._open.items():
            entry.rows = max(0, min(self.capacity, end - first_row))
        if self._mode.partitions[-1].key not in {entry.key for entry in self._open.values()}:
            self._owner.store.manifest.renumber()  # rows of others come after these

    def accept(self, index: int, checksums: Mapping[str, int]) -> bool:
        """List a full partition that its process has sealed; return whether its files agree."""
        found = next((entry for entry in self._open.values() if entry.index == index), None)
        if found is None or found.rows != self.capacity:
            return False
        directory, offsets = self._owner.store.directory, {}
        found = measure(directory, {field.name: field for field in self.fields}, found)
        for of in self.fields:
            file, rows = found.inspect(directory, of), found.rows_of(of)
            if file.identity != found.identity(of) or not file.is_sealed_form(rows):
                return False
            offsets[of.name] = file.data_offset
        del self._open[found.first_row]
        sealed = replace(
            found, offsets=offsets, sealed=True, writing=False, checksums=dict(checksums)
        )
        self._owner.list_sealed(sealed)
        return True

    def end_writing(self, lost: Callable[[int], None]) -> None:
        """Seal what the process leaves open; it writes no more, or in vain.

        Args:
            lost: Called with the number of rows that it has reported and that are not there.
        """
        directory = self._owner.store.directory
        fields = {field.name: field for field in self.fields}

        def seal_there(entry: Partition) -> Partition:
            there = _count(directory, self.fields, entry) if entry.rows else 0
            if there < entry.rows:
                lost(entry.rows - there)
                entry = replace(entry, rows=there)
            return seal(directory, fields, entry, statistics=False) if there else entry

        while self._open:
            _, entry = self._open.popitem()
            self._owner.seal(entry, seal_there)


class Delegation:
    """The rows of one mode that other processes write.

    Attributes:
        directory: The dataset's folder.
        proof: Content of the file `PROOF` in that folder.
        is_closed: Whether nobody writes them any more.
    """

    def __init__(self, owner: Owner, mode_name: str) -> None:
        """Let others find the folder; they need `define` before they can write."""
        self._owner, self._mode_name = owner, mode_name
        self.directory: Path = owner.store.directory
        self.proof = secrets.token_hex(16)
        self.is_closed = False
        self._shares: list[Share] = []
        self._lost = 0
        with files.storing(f"Rows in {self.directory}"):
            files.replace(self.directory / PROOF, self.proof.encode())

    def share(self, fields: Iterable[Field]) -> Share:
        """Give a process addresses to write rows at; the first call defines the fields.

        Args:
            fields: The fields of its rows, with their shapes.

        Raises:
            FieldsMismatchError: If the mode has different fields.
            DatasetError: If there is no table of episodes: see `Dataset.define_episodes`.
        """
        given = {field.name: field for field in fields}
        manifest = self._owner.store.manifest
        known = manifest.modes.get(self._mode_name)
        if known is None or known.fields != given:
            with (
                files.storing(f"The fields of mode {self._mode_name!r}"),
                self._owner.store.change() as manifest,
            ):
                mode = manifest.modes.setdefault(self._mode_name, Mode(given))
                compare_fields(f'Mode "{self._mode_name}" of the dataset', mode.fields, given)
                mode.fields = {name: given[name] for name in mode.fields}
        self._owner.recorder.end_stream(self._mode_name)  # without a record no row counts
        mode = manifest.modes[self._mode_name]
        capacity = self._owner.capacity(mode, TYPICAL)
        share = Share(self._owner, self._mode_name, list(mode.files.values()), capacity)
        self._shares.append(share)
        return share

    def end(self, share: Share) -> None:
        """Seal what a process leaves open."""
        share.end_writing(self._note_lost)

    def has(self, first: int, rows: int) -> bool:
        """Return whether some process has reported all rows from an address on."""
        return any(s.first <= first and first + rows <= s.end for s in self._shares)

    def read(self, first: int, rows: int) -> Batch:
        """Return rows that a process has reported, from an address on."""
        manifest = self._owner.store.manifest
        mode, reader = manifest.modes[self._mode_name], Reader(self.directory, manifest)
        start = Addresses(mode).stored(first)
        return {
            name: reader.read(self._mode_name, name, start, start + rows) for name in mode.fields
        }

    def close(self) -> None:
        """Seal what is left open; from now on this process may write the mode again.

        Raises:
            DatasetError: If reported rows are missing; all others are kept.
        """
        if self.is_closed:
            return
        for share in self._shares:
            self.end(share)
        self._owner.wait()
        self.is_closed = True
        self.remove_proof()
        if self._lost:
            raise DatasetError(
                f"{self._lost} rows that clients wrote to {self.directory} are missing. Was one of "
                "their machines switched off? Episodes without all their rows do not count: "
                "`physx generate --resume` simulates them again."
            )

    def remove_proof(self) -> None:
        """Remove the `PROOF` file."""
        with contextlib.suppress(OSError):
            files.remove(self.directory / PROOF)

    def _note_lost(self, rows: int) -> None:
        self._lost += rows


def _count(directory: Path, fields: Iterable[Field], entry: Partition) -> int:
    """Return how many rows of an open partition are there, up to those that were reported."""
    known = {field.name: field for field in fields}
    counts = {}
    for name, field in known.items():
        _, kept = entry.find_rows(directory, field, thorough=True)
        if kept is None:
            return 0
        counts[name] = min([kept.commit.rows, *(start for start, _ in kept.damaged)])
    return count_rows(directory, known, replace(entry), counts)
