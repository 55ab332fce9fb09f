"""Writes the table of episodes: see `physx_core.dataset.store.episode_table`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from physx_core import files
from physx_core.dataset.read.order.addresses import Addresses
from physx_core.dataset.read.order.records import Records
from physx_core.dataset.read.reader import Reader
from physx_core.dataset.store import failure_file
from physx_core.dataset.store.episode_record import OPEN, EpisodeRecord, EpisodeStatus
from physx_core.dataset.store.episode_table import (
    EPISODES,
    RECORDED,
    TABLE_FIELDS,
    has_table,
    mode_index,
)
from physx_core.dataset.store.failure_file import FailedEpisode
from physx_core.dataset.store.manifest import Manifest, Mode
from physx_core.dataset.store.manifest_store import ManifestStore
from physx_core.dataset.write.row_validation import stored_form
from physx_core.errors import DatasetError, UsageError
from physx_core.fields import Field
from physx_core.packing import split
from physx_core.rows import check_names
from physx_core.typing import Batch


class Storing(Protocol):
    """Stores rows; implemented by the dataset's writer.

    Attributes:
        store: The manifest.
    """

    store: ManifestStore

    def append(self, mode_name: str, rows: Batch, count: int) -> None:
        """Store and commit rows."""

    def sync(self, mode_name: str) -> None:
        """Wait until all rows of a mode are on the disk."""

    def note_path(self, path: Path) -> None:
        """Have a file on the disk soon."""


class Recorder:
    """Writes records, and those of streams before and after episodes.

    Attributes:
        recorded: Modes in which the next rows count only with a record.
    """

    def __init__(self, writer: Storing, reader: Reader) -> None:
        """Start without records; call `load` if there may be some."""
        self.recorded: set[str] = set()
        self._writer, self._reader = writer, reader
        self._streams: dict[str, tuple[int, int]] = {}  # campaign and first row of open ones
        self._campaigns: dict[str, int] = {}  # the last one
        self._unfinished: dict[tuple[str, int, int], tuple[int, int]] = {}  # next part, and rows

    def load(self) -> None:
        """Look at the records that there are; unfinished episodes that lack rows begin anew.

        Raises:
            DatasetError: If the table of episodes cannot be read.
        """
        if not has_table(self.manifest):
            return
        for known in (self.recorded, self._streams, self._campaigns, self._unfinished):
            known.clear()
        for mode in RECORDED:
            records = self._reader.orders.records(mode)
            if len(records.rows):
                self._load(mode, records)

    def _load(self, mode: str, records: Records) -> None:
        """Look at the records about a mode; one by one at those of streams and of parts only."""
        addresses = Addresses(self.manifest.modes.get(mode, Mode({})))
        more = records.status == EpisodeStatus.MORE
        single = ~np.isin(records.episode, records.episode[more])
        single &= records.status != EpisodeStatus.STREAM
        last = records.take(single)
        if len(last.rows):
            self._note_end(mode, int(last.campaign.max()), int((last.first_row + last.rows).max()))
        columns = (column.tolist() for column in records.take(~single))
        for campaign, episode, _, first, rows, part, status in zip(*columns, strict=True):
            self._note(mode, campaign, episode, first, rows, part, status)
            if status == EpisodeStatus.MORE and not addresses.has_all(first, rows):
                self._unfinished.pop((mode, campaign, episode), None)

    def append(
        self,
        mode: str,
        rows: Batch,
        count: int,
        episodes: Sequence[EpisodeRecord],
        table: Batch,
        first: int | None = None,
    ) -> None:
        """Store rows and then the records that commit them.

        Args:
            mode: Name of a mode whose fields all have shapes.
            rows: Field name to checked rows.
            count: Number of rows.
            episodes: The records.
            table: Their rows in the table, checked, but for the first rows.
            first: Address of the rows if another process has written them.
        """
        self.end_stream(mode)
        if count and first is None:
            self.recorded.discard(mode)
            try:
                self._writer.append(mode, rows, count)
            finally:
                self.recorded.add(mode)
            first = _first_of_last(self.manifest.modes[mode], count)
        if count:
            table["first_row"] = first + np.cumsum(table["rows"]) - table["rows"]
        self.store_reasons(
            FailedEpisode(mode, each.campaign, each.episode, each.reason)
            for each in episodes
            if each.status is EpisodeStatus.FAILED
        )
        self._writer.append(EPISODES, table, len(table["rows"]))
        first = first or 0
        for each in episodes:
            self._note(mode, each.campaign, each.episode, first, each.rows, each.part, each.status)
            first += each.rows

    def store_reasons(self, failures: Iterable[FailedEpisode]) -> None:
        """Store why episodes failed."""
        new, directory = list(failures), self._writer.store.directory
        if new:
            with files.storing("The reasons of failed episodes"), self._writer.store.syncing():
                failure_file.append(directory, new)
                self._writer.note_path(directory / failure_file.FILE)

    def check(self, mode: str, episodes: Iterable[EpisodeRecord]) -> None:
        """Check that the parts of each episode follow one another.

        Raises:
            UsageError: If not.
        """
        parts = {key: part for key, (part, _) in self._unfinished.items()}
        for each in episodes:
            key = mode, each.campaign, each.episode
            if each.part and parts.get(key) != each.part:
                raise UsageError(
                    f"Part {each.part} of episode {each.episode} cannot be stored: the next one "
                    f"is {parts.get(key, 0)}."
                )
            parts[key] = each.part + 1 if each.status is EpisodeStatus.MORE else 0

    def unfinished(self, mode: str, campaign: int) -> dict[int, tuple[int, int]]:
        """Return the next part of each episode that has not ended, and how many rows it has."""
        known = self._unfinished.items()
        return {n: each for (name, of, n), each in known if (name, of) == (mode, campaign)}

    def begin_stream(self, mode: str) -> None:
        """Let the next rows of a mode with records count without records of their own.

        Raises:
            UsageError: If the dataset is shared.
        """
        if self._writer.store.shared:
            raise UsageError(
                f'Mode "{mode}" holds episodes, to which only a dataset\'s sole writer can add '
                "rows: open it without shared=True."
            )
        known = self.manifest.modes[mode]
        first = max(Addresses(known).end, known.taken)
        self._store_stream(mode, self._campaigns[mode] + 1, first, OPEN)

    @property
    def manifest(self) -> Manifest:
        """The dataset's contents."""
        return self._writer.store.manifest

    def has_records(self, mode: str) -> bool:
        """Return whether there are records about a mode."""
        return mode in self._campaigns

    def next_campaign(self, mode: str) -> int:
        """Return the number of the campaign after all rows of a mode."""
        known = self.manifest.modes.get(mode)
        has_rows = known is not None and known.rows > 0
        return self._campaigns[mode] + 1 if mode in self._campaigns else int(has_rows)

    def ended_stream(self, mode: str) -> tuple[int, int, int] | None:
        """Return what ends the stream that takes a mode's rows: campaign, first row, and rows.

        None if no stream takes them.
        """
        if mode in self.recorded:
            return None
        campaign, first = self._streams.get(mode, (0, 0))
        known = self.manifest.modes.get(mode)
        end = 0 if known is None else Addresses(known).end
        return campaign, first, max(0, end - first)

    def end_stream(self, mode: str) -> None:
        """Let the next rows of a mode count only with a record."""
        if (stream := self.ended_stream(mode)) is not None:
            self._store_stream(mode, *stream)

    def _store_stream(self, mode: str, campaign: int, first: int, rows: int) -> None:
        """Store the record of a stream and wait until it is on the disk."""
        fields = self.manifest.modes[EPISODES].fields
        record = stored_form(fields, stream_record(fields, mode, campaign, first, rows))
        self._writer.append(EPISODES, record, 1)
        self._writer.sync(EPISODES)
        self._note(mode, campaign, -1, first, rows, 0, EpisodeStatus.STREAM)

    def _note(
        self, mode: str, campaign: int, episode: int, first: int, rows: int, part: int, status: int
    ) -> None:
        """Take note of a record."""
        is_open = status == EpisodeStatus.STREAM and rows == OPEN
        self._note_end(mode, campaign, first + (0 if is_open else rows))
        if status == EpisodeStatus.STREAM:
            self._streams.pop(mode, None)
            self.recorded.add(mode)
            if is_open:
                self._streams[mode] = campaign, first
                self.recorded.discard(mode)
            return
        key = mode, campaign, episode
        before, known = self._unfinished.pop(key, (0, 0))
        if status == EpisodeStatus.MORE and part in (0, before):
            self._unfinished[key] = part + 1, rows + (known if part else 0)

    def _note_end(self, mode: str, campaign: int, end: int) -> None:
        """Take note of a campaign, and of the address after recorded rows."""
        self._campaigns[mode] = max(campaign, self._campaigns.get(mode, 0))
        known = self.manifest.modes.get(mode)
        if known is not None:
            known.taken = max(known.taken, end)


def table_rows(
    mode: str, fields: Mapping[str, Field], episodes: Sequence[EpisodeRecord]
) -> dict[str, Any]:
    """Return the rows of the table for records, not yet checked and without their first rows.

    Args:
        mode: Name of the mode they speak of.
        fields: The fields of the table.
        episodes: The records.
    """
    own = [field.name for field in TABLE_FIELDS]
    others = {name: field for name, field in fields.items() if name not in own}
    once = {name: field for name, field in others.items() if field.role == "episode"}
    parameters = {name: field for name, field in others.items() if name not in once}
    for each in episodes:
        if each.parameters or parameters:
            check_names(parameters, each.parameters)
        if each.fields:
            check_names(once, each.fields)
    fixed = {"mode_index": mode_index(mode), "first_row": 0}
    found: dict[str, Any] = {
        name: np.array([fixed.get(name, getattr(each, name, 0)) for each in episodes], of.dtype)
        for name, of in fields.items()
        if name in own
    }
    if (parameters or once) and any(each.count > 1 for each in episodes):
        found = _one_by_one(found)
    found |= {name: _values(name, of, episodes) for name, of in parameters.items()}
    return found | {name: _values_once(name, of, episodes) for name, of in once.items()}


def _one_by_one(table: Batch) -> Batch:
    """Return rows of the table with one for each number."""
    count = table["count"]
    found = {name: np.repeat(values, count) for name, values in table.items()}
    begins = np.repeat(np.cumsum(count) - count, count)
    found["episode"] += np.arange(len(begins)) - begins
    found["seconds"] /= np.repeat(count, count)
    found["rows"][np.repeat(count > 1, count)] = 1
    found["count"][:] = 1
    return found


def _values(name: str, field: Field, episodes: Sequence[EpisodeRecord]) -> Any:
    """Return the values of a parameter for each number."""
    if all(each.count == 1 for each in episodes):
        return [each.parameters[name] for each in episodes]
    given = [
        each.parameters[name] if each.count > 1 else [each.parameters[name]] for each in episodes
    ]
    return np.concatenate([field.convert(values, axes=1) for values in given])


def _values_once(name: str, field: Field, episodes: Sequence[EpisodeRecord]) -> list[Any]:
    """Return the values of a field that an episode has once, for each number; 0 if it has none."""
    size = (0, *field.entry_shape) if field.free_axis else field.entry_shape
    none = np.zeros(size, field.dtype)
    return [value for e in episodes for value in [e.fields.get(name, none)] * e.count]


def stream_record(
    fields: Mapping[str, Field], mode: str, campaign: int, first: int, rows: int
) -> Batch:
    """Return the row of the table for a stream."""
    values = {
        "mode_index": mode_index(mode),
        "campaign": campaign,
        "episode": -1,
        "count": 1,
        "first_row": first,
        "rows": rows,
        "status": EpisodeStatus.STREAM,
    }
    return {
        name: split(np.empty((0, *field.entry_shape), field.dtype), np.zeros(1, np.intp))
        if field.free_axis
        else np.full((1, *field.entry_shape), values.get(name, 0), field.dtype)
        for name, field in fields.items()
    }


def _first_of_last(mode: Mode, count: int) -> int:
    """Return the address of the first one of the last `count` rows."""
    last = mode.partitions[-1]
    first = last.first_row + last.rows - count
    if first < last.first_row and not Addresses(mode).has_all(first, count):
        raise DatasetError(
            "Episodes could not be stored in one piece because removed partitions are left over. "
            "Store them again."
        )
    return first
