"""The manifest: a dataset's modes, fields, partitions, and origin.

`physx_core.dataset.store.manifest_file` stores it as ``dataset.json``, and what changes often in a
file beside it, `physx_core.dataset.store.statistics_file` the statistics of its rows beside it.
"""

from __future__ import annotations

import bisect
import functools
import json
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any, overload

import numpy as np
from xxhash import xxh3_64_intdigest

from physx_core.dataset.store.changes_file import End
from physx_core.dataset.store.partition.commits import Kept, Range
from physx_core.dataset.store.partition.format import (
    Identity,
    Inspection,
    find_rows,
    inspect,
    partition_file,
)
from physx_core.dataset.store.partition.segment import Segment
from physx_core.dataset.store.partition.spans import Span
from physx_core.errors import ConfigError, DatasetError
from physx_core.fields import Field, ends_fields, free_axes
from physx_core.statistics import RunningStatistics


@dataclass
class Partition:
    """Consecutive rows of one mode: one file for each field.

    Attributes:
        mode: Name of the mode.
        session: Session that wrote it.
        index: Its number in the session and mode, counted from 0.
        first_row: Address of its first row; orders the partitions.
        rows: Number of committed rows, the same in all fields.
        sizes: Number of entries of these rows, by free axis.
        sealed: Whether it is complete: every file has exactly these rows.
        offsets: Byte of the file at which the rows begin, by field.
        checksums: CRC-32 of the rows, by field; empty until it is sealed, and while rows are
            updated in place.
        counted: Whether the mode's statistics include its rows.
        writing: Whether this process has begun it, so that `offsets` are valid before it is sealed.
        follows: While it is not sealed, number of the partition that its writer filled before it,
            and that one's number of rows: if any of them is missing, its own rows do not count.
        kept: While it is not sealed, what counts in its files as found in them, by field; not
            stored.
        damaged: While it is not sealed, which of its rows are damaged in any field; not stored.
        problem: Why some of its rows cannot be read although its files count them; not stored.
        running: Statistics of its first rows while it is not counted, by field; not stored.
    """

    mode: str
    session: str
    index: int
    first_row: int
    rows: int = 0
    sizes: dict[str, int] = field(default_factory=dict)
    sealed: bool = False
    offsets: dict[str, int] = field(default_factory=dict)
    checksums: dict[str, int] = field(default_factory=dict)
    counted: bool = False
    writing: bool = False
    follows: tuple[int, int] | None = None
    kept: dict[str, Kept] = field(default_factory=dict, compare=False)
    damaged: tuple[Range, ...] = field(default=(), compare=False)
    problem: str = field(default="", compare=False)
    running: dict[str, RunningStatistics] = field(default_factory=dict, compare=False)

    @property
    def key(self) -> tuple[str, int]:
        """Key that is unique among the partitions of its mode."""
        return self.session, self.index

    def rows_of(self, of: Field) -> int:
        """Return the number of rows of a field's file: with a free axis, of entries."""
        return self.sizes[of.free_axis] if of.free_axis else self.rows

    def file_name(self, name: str) -> str:
        """Return the name of a field's file."""
        return partition_file(self.session, self.mode, name, self.index)

    def path(self, directory: Path, name: str) -> Path:
        """Return the path of a field's file."""
        return directory / self.file_name(name)

    def identity(self, of: Field) -> Identity:
        """Return the identity of a field's file."""
        return Identity(self.session, self.mode, of, self.index, self.first_row)

    def inspect(self, directory: Path, of: Field) -> Inspection:
        """Return the contents of the header of a field's file."""
        return inspect(self.path(directory, of.name), self.offsets.get(of.name), of.nbytes)

    def find_rows(
        self, directory: Path, of: Field, *, thorough: bool
    ) -> tuple[Inspection, Kept | None]:
        """Return the header of a field's file and the rows that count in it."""
        path, offset = self.path(directory, of.name), self.offsets.get(of.name)
        return find_rows(path, offset, of.nbytes, thorough=thorough)

    def segment(self, directory: Path, of: Field, span: Span | None = None) -> Segment:
        """Return the rows of a field, which have the places of `span` in the mode."""
        return Segment(
            self.path(directory, of.name),
            of,
            span or Span(0, self.rows_of(of)),
            self.offsets.get(of.name, 0),
            self.sealed,
            self.checksums.get(of.name),
            self._kept_of(of),
        )

    def digest(self, fields: Mapping[str, Field]) -> str:
        """Return a digest of its fields and checksums; empty while it has no checksums."""
        if not self.sealed or not self.checksums:
            return ""
        kept = [(name, of.dtype, of.shape, self.checksums.get(name)) for name, of in fields.items()]
        kept += [(n, "", (), self.checksums.get(n)) for n in ends_fields(fields.values())]
        return f"{xxh3_64_intdigest(repr(kept).encode()):016x}"

    def _kept_of(self, of: Field) -> Kept | None:
        kept = self.kept.get(of.name)
        return kept if kept is not None and kept.commit.rows >= self.rows_of(of) else None

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; the row count of an open partition is only in its files."""
        plain: dict[str, Any] = {
            "session": self.session,
            "index": self.index,
            "first_row": self.first_row,
            "sealed": self.sealed,
            "offsets": self.offsets,
        }
        if self.sealed:
            crc32 = {name: f"{value:08x}" for name, value in self.checksums.items()}
            plain |= {"rows": self.rows, "crc32": crc32, "counted": self.counted}
            if self.sizes:
                plain["sizes"] = self.sizes
        elif self.follows is not None:
            plain["follows"] = list(self.follows)
        return plain


class Partitions(Sequence[Partition]):
    """The partitions of a mode in the order of their rows; knows which ones have which rows.

    The rows before the first partition that is not sealed are added up once.
    """

    def __init__(self, partitions: Iterable[Partition] = ()) -> None:
        self._list = list(partitions)
        self._keys = {partition.key for partition in self._list}
        self._starts, self._ends = [0], [0]  # rows and addresses before the first ones and the next

    @overload
    def __getitem__(self, place: int) -> Partition: ...
    @overload
    def __getitem__(self, place: slice) -> list[Partition]: ...
    def __getitem__(self, place: int | slice) -> Partition | list[Partition]:
        return self._list[place]

    def __len__(self) -> int:
        return len(self._list)

    def __iter__(self) -> Iterator[Partition]:
        return iter(self._list)

    def add(self, partition: Partition) -> None:
        """Add a partition at its place."""
        place = bisect.bisect(self._list, partition.first_row, key=lambda each: each.first_row)
        self.exchange(place, 0, [partition])

    def remove(self, partition: Partition) -> None:
        """Remove a partition, whatever its state."""
        self.exchange(self.place(partition.key), 1, [])

    def exchange(self, place: int, count: int, partitions: Sequence[Partition]) -> None:
        """Let others take the place of some partitions."""
        del self._starts[place + 1 :], self._ends[place + 1 :]
        self._keys.difference_update(each.key for each in self._list[place : place + count])
        self._keys.update(each.key for each in partitions)
        self._list[place : place + count] = partitions

    def has(self, key: tuple[str, int]) -> bool:
        """Return whether there is a partition with a key."""
        return key in self._keys

    def place(self, key: tuple[str, int]) -> int:
        """Return the number of the partition with a key.

        Raises:
            ValueError: If there is none.
        """
        for place in range(len(self._list) - 1, -1, -1):  # those that change are the last ones
            if self._list[place].key == key:
                return place
        raise ValueError(f"there is no partition {key}")

    def last_index(self, session: str) -> int:
        """Return the number of a session's last partition, -1 if it has none."""
        own = (each.index for each in reversed(self._list) if each.session == session)
        return next(own, -1)

    @property
    def rows(self) -> int:
        """Number of rows."""
        known = self._add_up()
        return self._starts[-1] + sum(each.rows for each in self._list[known:])

    @property
    def end(self) -> int:
        """Address after those of all partitions."""
        known = self._add_up()
        return max(self._ends[-1], *(_end(each) for each in self._list[known:]), 0)

    def between(self, start: int, stop: int) -> Iterator[tuple[Partition, Span]]:
        """Yield the partitions that have some of the rows `start` to `stop`, and their spans."""
        known = self._add_up()
        place = bisect.bisect(self._starts, start, hi=known) - 1 if known else 0
        begin = self._starts[place]
        for each in self._list[place:]:
            if begin >= stop:
                break
            if start < begin + each.rows and each.rows:
                yield each, Span(begin, each.rows)
            begin += each.rows

    def _add_up(self) -> int:
        """Add up the first partitions, all of them sealed; return how many they are."""
        known, starts, ends = len(self._starts) - 1, self._starts, self._ends
        while known < len(self._list) and self._list[known].sealed:
            each, known = self._list[known], known + 1
            starts.append(starts[-1] + each.rows)
            ends.append(max(ends[-1], _end(each)))
        return known


def _end(partition: Partition) -> int:
    """Return the address after a partition, which takes one at least."""
    return partition.first_row + max(1, partition.rows)


@dataclass
class Mode:
    """The rows of one mode.

    Attributes:
        fields: The fields by name; a shape is None until the first rows determine it.
        partitions: The partitions in the order of their rows.
        statistics: Statistics of floating-point fields over the rows of all counted partitions;
            None while they are only in their file: `statistics_file.load` reads them.
        dropped: Partitions that do not belong to the mode although their files may exist: they are
            being removed, or copied from another dataset.
        removed: Largest number of a removed partition, by session. It is never reused, so that a
            reader that still lists the removed partition cannot mistake new rows for its rows.
        taken: End of the addresses that are never used again although there may be no rows: the
            table of episodes speaks of them, or other processes may yet write them. Not stored.
    """

    fields: dict[str, Field]
    partitions: Partitions = field(default_factory=Partitions)
    statistics: dict[str, RunningStatistics] | None = field(default_factory=dict)
    dropped: list[Partition] = field(default_factory=list)
    removed: dict[str, int] = field(default_factory=dict)
    taken: int = 0

    @property
    def ends(self) -> dict[str, Field]:
        """The fields that say where the entries of a row end in its partition, by name."""
        return ends_fields(self.fields.values())

    @property
    def axes(self) -> list[str]:
        """Names of the free axes."""
        return list(free_axes(self.fields.values()))

    @property
    def files(self) -> dict[str, Field]:
        """The fields that have files, in the order in which their rows are committed."""
        ends = self.ends
        return self.fields | ends if ends else self.fields

    @property
    def rows(self) -> int:
        """Number of committed rows."""
        return self.partitions.rows

    @property
    def next_row(self) -> int:
        """First row of the next partition, larger than that of any earlier one."""
        dropped = (_end(each) for each in self.dropped)
        return max(self.rows, self.partitions.end, *dropped, self.taken)

    def next_index(self, session: str) -> int:
        """Return the number of a session's next partition, which no other one has ever had."""
        dropped = (each.index for each in self.dropped if each.session == session)
        last = max(self.partitions.last_index(session), self.removed.get(session, -1), *dropped, -1)
        return last + 1

    @property
    def counted_fields(self) -> dict[str, Field]:
        """The fields that have statistics."""
        return {name: of for name, of in self.fields.items() if of.has_statistics}

    def place(self, partition: Partition) -> int:
        """Return the position of a partition, even if it has been replaced by a later state."""
        return self.partitions.place(partition.key)

    @property
    def spans(self) -> list[Span]:
        """Rows of the mode that each partition currently has."""
        found, start = [], 0
        for partition in self.partitions:
            found.append(Span(start, partition.rows))
            start += partition.rows
        return found

    def add(self, partition: Partition) -> None:
        """Add a partition at its place."""
        self.partitions.add(partition)

    def swap(self, partition: Partition) -> None:
        """Replace the earlier state of a partition."""
        self.partitions.exchange(self.place(partition), 1, [partition])

    def put(self, partition: Partition) -> None:
        """Add a partition or replace its earlier state."""
        if self.partitions.has(partition.key):
            self.swap(partition)
        else:
            self.add(partition)

    def forget_statistics(self) -> None:
        """Discard the statistics, so that they are recomputed from all rows."""
        self.statistics = {}
        for place, partition in enumerate([*self.partitions]):
            partition.running = {}
            if partition.counted:
                self.partitions.exchange(place, 1, [replace(partition, counted=False)])

    def continues(self, earlier: Mode) -> bool:
        """Return whether all rows of an earlier state still exist under the same numbers."""
        before, now = earlier.with_rows, self.with_rows
        last = before[-1].key if before else None
        grown = all(
            old.key == new.key
            and (old.rows == new.rows or (old.key == last and old.rows < new.rows))
            for old, new in zip(before, now, strict=False)
        )
        return grown and len(now) >= len(before) and self.rows >= earlier.rows

    def keeps_values(self, earlier: Mode) -> bool:
        """Return whether no row of an earlier state, which it continues, was updated."""
        pairs = zip(earlier.with_rows, self.with_rows, strict=False)
        return all(old.checksums == new.checksums or not old.sealed for old, new in pairs)

    @property
    def with_rows(self) -> list[Partition]:
        """The partitions that have rows."""
        return [partition for partition in self.partitions if partition.rows]

    def copy(self) -> Mode:
        """Return a copy to change while this one stays; the partitions are shared."""
        return Mode(
            dict(self.fields),
            Partitions(self.partitions),
            None if self.statistics is None else dict(self.statistics),
            list(self.dropped),
            dict(self.removed),
            self.taken,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        plain: dict[str, Any] = {
            "fields": [of.to_dict() for of in self.fields.values()],
            "partitions": [partition.to_dict() for partition in self.partitions],
        }
        if self.removed:
            plain["removed"] = self.removed
        if self.dropped:
            plain["dropped"] = [partition.to_dict() for partition in self.dropped]
        return plain


def versions() -> dict[str, str]:
    """Return the versions of the software that writes datasets."""
    packages = ("physx-core", "numpy", "h5py")
    return {"python": platform.python_version()} | {name: _version_of(name) for name in packages}


@functools.cache
def _version_of(package: str) -> str:
    return metadata.version(package)


@dataclass
class Manifest:
    """Everything in a dataset except its rows.

    Attributes:
        modes: The modes by name.
        info: Where the data come from: environment, its keyword arguments, seed, etc.
        versions: Versions of Python and of the packages that created the dataset.
        statistics_checksum: CRC-32 of the file with the statistics of the counted partitions;
            None if they are not stored yet.
        problems: Modes whose rows cannot be counted, and why; not stored.
        generation: Increases whenever known rows have been changed or renumbered, which makes
            rows kept in memory stale; not stored.
        numbering: Increases whenever known rows have been renumbered; not stored.
        end: Where changes of what is stored go; None if it is not stored like this.
    """

    modes: dict[str, Mode] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=versions)
    statistics_checksum: int | None = None
    problems: dict[str, DatasetError] = field(default_factory=dict)
    generation: int = 0
    numbering: int = 0
    end: End | None = None

    @property
    def sessions(self) -> list[str]:
        """Names of the sessions that wrote rows, in the order of their rows."""
        found = [p.session for mode in self.modes.values() for p in mode.partitions]
        return list(dict.fromkeys(found))

    @property
    def has_new_statistics(self) -> bool:
        """Whether there are statistics that are not stored yet."""
        return self.statistics_checksum is None and any(
            mode.statistics for mode in self.modes.values()
        )

    @property
    def has_changes(self) -> bool:
        """Whether changes were stored that are not in the file of the manifest."""
        return self.end is not None and self.end.nbytes > 0

    @property
    def file_names(self) -> set[str]:
        """Names of all partition files, including dropped ones."""
        return {
            partition.file_name(of)
            for mode in self.modes.values()
            for partition in (*mode.partitions, *mode.dropped)
            for of in mode.files
        }

    def copy(self) -> Manifest:
        """Return a copy to change while this one stays; the partitions are shared."""
        return Manifest(
            {name: mode.copy() for name, mode in self.modes.items()},
            dict(self.info),
            dict(self.versions),
            self.statistics_checksum,
            dict(self.problems),
            end=self.end,
        )

    def renumber(self) -> None:
        """Note that known rows have other numbers, or are no longer there."""
        self.generation += 1
        self.numbering += 1

    def take(self, other: Manifest) -> None:
        """Take over the contents of `other`."""
        known = {name: mode for name, mode in self.modes.items() if name not in self.problems}
        if not all(n in other.modes and other.modes[n].continues(m) for n, m in known.items()):
            self.renumber()
        elif not all(other.modes[name].keeps_values(mode) for name, mode in known.items()):
            self.generation += 1
        self.modes, self.info = other.modes, other.info
        self.statistics_checksum = other.statistics_checksum
        self.versions, self.problems = other.versions, other.problems
        self.end = other.end


def to_plain_info(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as the manifest will return them; tuples and arrays become lists."""

    def convert(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        if isinstance(value, Path):
            return str(value)
        if isinstance(value, type):
            return f"{value.__module__}:{value.__qualname__}"
        raise TypeError(f"JSON cannot represent {value!r}")

    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(values), default=convert))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"The dataset's info cannot be stored: {error}.") from error
    return plain
